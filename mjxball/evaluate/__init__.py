"""Evaluation: scenarios, benchmark suites, metrics, figures, and the report."""
