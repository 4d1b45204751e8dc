"""The pair without a laptop in the loop: apps for the Crazyflie's firmware, and the same C for the twin."""
