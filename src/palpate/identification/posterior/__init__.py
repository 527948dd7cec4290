"""Bayesian identification: likelihood, modes, draws, predictions, calibration."""
