"""Advance the plant one control step. Interchangeable engines give accelerations; one integrator moves the state."""
