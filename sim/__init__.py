"""The world: airport and Summit XL in MuJoCo, sensors, judge, fault injection, campaigns."""
