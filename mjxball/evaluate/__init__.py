"""Judge followers: scenarios, metrics, figures, and the tables that `eval.py` prints."""
