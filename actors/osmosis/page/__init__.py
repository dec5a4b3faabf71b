"""What the operator's page shows and takes for Osmosis: map, laser, missions, stick."""
