"""Learning algorithms: one class in one file each. `mjxball.algorithms.base` says what the trainer asks of it."""
