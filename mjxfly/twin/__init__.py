"""Software twin of the pair: two CRTP peers over UDP on loopback that the unmodified cflib opens.

`conditions` (which drones, what they meet, which faults), `protocol` and `logs` (bytes in, bytes out), `supervisor`,
`firmware` and `drone` (what a drone makes of them), `physics` (its interface, a simple stand-in), `coupled`, `onboard`
and `estimators` (the Crazyflie model), `server` (sockets and clock), `virtual` (flights without either),
`captured` (the same on motion capture).
"""
