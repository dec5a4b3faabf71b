"""The recovery modules of Osmosis: stops, reduced speed, teleoperation, replanning."""
