"""Commands that need no run: campaigns, decisions, trees, cut sets, proofs."""
