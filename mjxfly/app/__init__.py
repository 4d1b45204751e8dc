"""Control of a pair on board: C apps for the Crazyflie's firmware, and the same C compiled for the twin."""
