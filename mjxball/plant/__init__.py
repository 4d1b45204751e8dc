"""Parameters of the plant (rigid team of drones and load) as a pytree of arrays. Importing it needs NumPy alone."""

from mjxball.plant.parameters import (
    ROLLING_INERTIA,
    AttitudeGains,
    PlantParameters,
    box_inertia_per_mass,
    design_gains,
    plant_parameters,
)

__all__ = [
    "ROLLING_INERTIA",
    "AttitudeGains",
    "PlantParameters",
    "box_inertia_per_mass",
    "design_gains",
    "plant_parameters",
]
