"""Evaluation: scenarios, metrics, results, figures and rendered flights."""
