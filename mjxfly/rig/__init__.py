"""Design of a rig: feasibility and loads, gains of the coupled attitude loops, identification from flight logs."""
