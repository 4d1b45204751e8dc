"""Software twin of the pair: two CRTP peers over UDP on loopback that the unmodified cflib opens.

`conditions`: kinds of drones, surroundings, faults, and their flags. `protocol`, `parameters` and `logs`: CRTP packets.
`arming`, `firmware` and `drone`: the firmware's supervisor and commander, the app, the link. `pair`: interface of the
physics, with two implementations, `physics` (simple) and `coupled` (MuJoCo with `avionics`, `estimators` and
`positioning`). `server`: sockets and real time. `virtual`: flights in virtual time.
"""
