"""Types of `configs/dart.yaml`: the vehicle, its sensors, its materials, the lock and all thresholds.

The types define the schema (`docs/schemas/`) and document every key. The file contains the values and their
sources.
"""

from dart_flight.config.vehicle.airframe import (
    Airframe,
    Coefficients,
    Imu,
    Material,
    Motor,
    Thrust,
    effectiveness,
)
from dart_flight.config.vehicle.autopilot import Px4Parameters
from dart_flight.config.vehicle.configuration import (
    VehicleConfig,
    default_config_path,
    load_vehicle,
    packaged,
)
from dart_flight.config.vehicle.estimation import (
    ArmVibration,
    Detection,
    Estimation,
    ThresholdTest,
    ThrustSource,
    WallPrior,
)
from dart_flight.config.vehicle.flying import Flying
from dart_flight.config.vehicle.lock_config import (
    Cam,
    LimitSwitch,
    LockConfig,
    LockDriver,
    LockStartup,
    Servo,
)
from dart_flight.config.vehicle.simulation import BodyModel, ContactBody, ImuRinging, Simulation

__all__ = [
    "Airframe",
    "ArmVibration",
    "BodyModel",
    "Cam",
    "Coefficients",
    "ContactBody",
    "Detection",
    "Estimation",
    "Flying",
    "Imu",
    "ImuRinging",
    "LimitSwitch",
    "LockConfig",
    "LockDriver",
    "LockStartup",
    "Material",
    "Motor",
    "Px4Parameters",
    "Servo",
    "Simulation",
    "ThresholdTest",
    "Thrust",
    "ThrustSource",
    "VehicleConfig",
    "WallPrior",
    "default_config_path",
    "effectiveness",
    "load_vehicle",
    "packaged",
]
