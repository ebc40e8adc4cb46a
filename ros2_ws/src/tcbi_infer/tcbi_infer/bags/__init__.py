"""Bags: rollouts on disk as the contract lays them out, written, read, repaired."""
