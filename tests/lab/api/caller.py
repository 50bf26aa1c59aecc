"""A ten-line caller, which mypy --strict checks in the tree and against the installed wheel."""

import dart_flight

vehicle = dart_flight.load_vehicle().replace({"materials.acrylic.rigid.k": 5000.0})
mission = dart_flight.load_mission(dart_flight.packaged("missions", "paper_single_wall.yaml"), vehicle)
flight = dart_flight.simulate(mission.replace({"collisions[0].mode": "rigid"}), seed=2, vary={"mass": 0.1})
force = flight.log["/estimate/force"]
strongest_n = float(abs(force.force_mission[force.t_s > 0.0, 0]).max())
hit = dart_flight.predict(vehicle, "acrylic", "rigid", -1.0, 0.5)
followed: bool | None = flight.verdict.plan_followed
print(flight.verdict.outcome.value, followed, strongest_n > 10.0, hit.peak_normal_force_n > 10.0)
