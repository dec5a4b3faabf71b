"""Fault trees, mechanisms and orders as diagrams."""
