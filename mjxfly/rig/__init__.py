"""The rig on the bench: gains for two drones that turn one body, and a plant file from a log of its flight."""
