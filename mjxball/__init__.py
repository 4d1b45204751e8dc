"""mjxball: two quadrotors carry one object whose centre of gravity moves."""

__version__ = "0.1.0"
