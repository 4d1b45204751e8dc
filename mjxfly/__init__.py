"""Laptop flight program for two Crazyflies, and a software twin of the pair. No JAX; MuJoCo in `twin.coupled` alone.

Data flow: `packets` (bytes <-> SI) -> `link` (one drone over cflib) -> `telemetry` (state of the object from both)
-> `controller` (leader PID and follower policy; `policy_setup` reads the metadata) -> `setpoints` (thrust units) and
`monitor` (faults)
-> `supervisor` (pure state machine) -> `flight` (one tick) -> `session` (threads, clocks, printing) -> `main`.
`flight_log` and `recording` read a log back. The commands `log` and `view` show it; `rig` computes gains and identifies
the rig from it. `app` builds the same controllers as apps of the firmware. Files, clocks, sockets and printing stay at
the edges. O is the object's reference point, the origin of its body frame.
"""
