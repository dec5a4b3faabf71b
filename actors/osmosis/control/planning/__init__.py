"""The Graph Planner: ways through the airport, round what is closed."""
