"""Laptop runner for two Crazyflies and a software twin of the pair. No JAX; MuJoCo in `twin.coupled` alone.

The way of the data: `packets` (bytes <-> SI) -> `link` (one drone over cflib) -> `pair` (object's state from both)
-> `controller` (leader PID and follower policy, by the policy's `card`) -> `command` (command map) -> `supervisor`
(pure table of states) -> `flight` (one tick) -> `session` (threads, clocks, printing) -> `main`. `recording` reads a
log back. Files, clocks, sockets and printing live at the edges.
"""
