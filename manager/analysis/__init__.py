"""What can be proved of a specification: verification, cut sets, barriers, Open-PSA."""
