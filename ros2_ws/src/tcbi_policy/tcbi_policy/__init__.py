"""Rewards, training, policy artefacts, the policy node and the retrain action."""
