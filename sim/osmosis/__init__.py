"""The world of Osmosis in MuJoCo: Summit XL, sensors, judge, report."""
