"""Training: soft actor-critic on Brax's networks, losses and running statistics, in one compiled program."""
