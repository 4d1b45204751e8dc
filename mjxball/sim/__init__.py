"""Simulated flight: the closed loop of sensors, drones and physics, its disturbances, and the reset distribution."""
