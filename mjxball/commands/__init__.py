"""Command lines of training and evaluation. No other part of the package imports them."""
