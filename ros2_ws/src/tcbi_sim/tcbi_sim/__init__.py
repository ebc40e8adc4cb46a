"""Rigs, physical effects, model versions, batch simulation and the sim node."""
