"""Real and virtual runs, from start to verdict, with their console output and reports."""
