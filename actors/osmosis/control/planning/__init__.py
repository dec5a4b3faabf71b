"""The Graph Planner: routes over the airport's graph, around closures."""
