"""Laptop runner for two Crazyflies and a software twin of the pair. No JAX; MuJoCo in `twin.coupled` alone.

The way of the data: `packets` (bytes <-> SI) -> `link` (one drone over cflib) -> `telemetry` (object's state from both)
-> `card` (policy's card, leader PID and follower policy) -> `command` (thrust units) and `monitor` (what is wrong)
-> `supervisor` (pure table of states) -> `flight` (one tick) -> `session` (threads, clocks, printing) -> `main`.
`flight_log` and `recording` read a log back; the commands `log` and `view` show it, and `rig` computes gains and
identifies the rig from it. `app` makes the same laws apps of the firmware. Files, clocks, sockets and printing live at
the edges.
"""
