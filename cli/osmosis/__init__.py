"""Commands for Osmosis: mission, joystick, obstacle; its lines of status, top and metrics."""
