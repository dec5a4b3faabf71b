"""The operator's page of Osmosis: map, lasers, missions, joystick."""
