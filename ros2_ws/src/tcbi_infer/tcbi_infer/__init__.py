"""Bags, statistics, TCBI, comparison, diagnosis and the inference node."""
