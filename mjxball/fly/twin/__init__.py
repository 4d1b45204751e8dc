"""Software twin of the pair: two CRTP peers over UDP on loopback that the unmodified cflib opens.

`tables` (what a drone lists), `protocol` (bytes in, bytes out), `firmware` (what it does in trouble), `body` (the
interface of the physics), `coupled` (the Crazyflie model), `conditions` (what it meets), `standin` (simple physics),
`pairs` (which of the two), `faults` (of the link), `server` (sockets and clock).
"""
