"""Estimators on the kinematic model: accelerometers and yaw rate integrated, no tyres."""
