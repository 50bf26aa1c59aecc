"""The simulated vehicle as a body: six degrees of freedom, motors, drag, walls, ground, arms.

The state is in NED and FRD, as in the autopilot. Walls are given in the mission frame and converted to NED
once.
Contacts follow the law in `dart_flight.contact.law`. They act at guards (`contact/propeller_guards.py`), or
through the centre of mass as in the paper's equations (`simulation.contact.body: point`). Contacts are
integrated in steps of 0.1 ms, everything else in steps of 1 ms. `contact/cylinders.py` handles posts and the
ends of walls. `tests/sim/test_plant.py` compares the point body with reference solutions.
`tests/sim/test_body.py` and `tests/sim/test_ends_and_posts.py` compare the guards with independent models of
a rigid body.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import Final, NamedTuple

import msgspec

from dart_flight.base.arithmetic import sum_in_order
from dart_flight.base.geometry import (
    GRAVITY_M_S2,
    MissionFrame,
    Quaternion,
    Vec2,
    Vec3,
    add,
    advance_attitude,
    body_up,
    gyroscopic_torque,
    integrate_rate,
    norm,
    quaternion_from_euler,
    rotate,
    rotate_back,
    scale,
    subtract,
    tilt_of,
    wrap_angle,
    yaw_ned_of,
)
from dart_flight.base.records import Mode, TruthContact, TruthSample
from dart_flight.base.walls import Post, Wall
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import BodyModel, Coefficients, VehicleConfig
from dart_flight.contact.cylinders import (
    EDGE_RADIUS_M,
    Cylinder,
    CylinderContact,
    NearestPoint,
    PostContact,
    WallWithEnds,
)
from dart_flight.contact.law import Onset, coefficients_in_force
from dart_flight.contact.propeller_guards import (
    NO_LOAD,
    BodyMotion,
    GuardLaw,
    Plane,
    PropellerGuard,
    WallLoad,
    arm_of,
    clearance_m,
    fold_angles,
    propeller_guards,
    touch,
)

STEP_S: Final = 0.001
CONTACT_STEPS: Final = 10  # number of steps of 0.1 ms in one step of 1 ms
_END_STEPS: Final = 40  # steps near a wall's end: a force may jump there as a guard leaves the surface
_NEAR_WALL_M: Final = 0.08  # a vehicle farther away and slower than 5 m/s begins no contact
_NEAR_END_M: Final = 0.03  # a guard farther than this from an edge does not reach it in one step (1 cm)
_BEHIND_M: Final = -0.6  # a vehicle farther behind the wall's plane is on the other side of the wall
_REBOUND_S: Final = 0.01  # a guard that returns within this time continues the same contact
_HALF_ENGAGED: Final = 0.5  # freedom of the arms with half-engaged rods, relative to unlocked arms
_GROUND_M: Final = 0.01  # above this height, the landing gear touches nothing
_NO_LOAD: Final = NO_LOAD
_NO_FORCE = (0.0, 0.0, 0.0)
_AT_REST = (0.0, 0.0, 0.0, 0.0)  # the arms' displacement north and east (m) and its rate (m/s)
_GAIN_M_S: Final = 0.5  # thrust increases the speed by less than this within a tick
_QUARTER = 0.5 * math.pi  # the vehicle has four-fold symmetry
GROUND_FRICTION: Final = 0.6  # rubber feet on a hall floor
_GROUND_STEPS: Final = 2  # steps per millisecond if only the landing gear touches; more steps change nothing
_GROUND_SPEED_M_S: Final = 0.05  # below this speed, the ground's friction decreases (regularisation)


class _WallPlane:
    """A wall in NED with the axes of its collision frame.

    Attributes:
        wall: the wall, mission frame.
        point, normal, tangent: plane of the vehicle's centre at the first touch, NED.
        ends: the wall's surface with its two ends.
        near_end: whether `ends` must compute contacts, because a guard may be near an end of the wall or
            `ends` still stores a contact's state.
        away: whether the vehicle was too far from the wall for a contact at the last check.
    """

    def __init__(self, wall: Wall, point: Vec3, normal: Vec3, tangent: Vec3, ends: WallWithEnds) -> None:
        self.wall, self.point, self.normal, self.tangent = wall, point, normal, tangent
        self.ends = ends
        self.near_end = False
        self.away = True

    @property
    def name(self) -> str:
        return self.wall.name

    @property
    def material(self) -> str:
        return self.wall.material

    @property
    def depths(self) -> list[float] | None:
        """Deflection of each guard if a guard may be near an end of the wall, otherwise None.

        If None, each guard's deflection equals the guard's depth behind the surface.
        """
        return self.ends.depths if self.near_end else None

    def move(self, away_m: float) -> None:
        self.wall = self.wall.displaced(away_m)
        self.point = add(self.point, scale(self.normal, away_m))
        self.ends = self.ends.displaced(away_m)


class _StandingPost:
    """A post in NED."""

    def __init__(self, post: Post, contact: PostContact) -> None:
        self.post, self.contact = post, contact

    @property
    def name(self) -> str:
        return self.post.name

    @property
    def material(self) -> str:
        return self.post.material

    @property
    def depths(self) -> list[float] | None:
        return self.contact.depths


_Obstacle = _WallPlane | _StandingPost


class _ContactStart(NamedTuple):
    obstacle: _Obstacle
    mode: Mode
    coefficients: Coefficients
    start_s: float
    normal: Vec3
    tangent: Vec3
    normal_in: float
    tangential_in: float
    position: Vec3
    incidence: float
    tilt: float
    fold_share: float


class _OpenContact:
    """A contact in progress, with the values that each force updates."""

    def __init__(self, start: _ContactStart) -> None:
        self.start = start
        self.peak_normal = self.peak_friction = self.peak_torque = 0.0
        self.last_s = start.start_s  # time of the newest force
        self.velocity_out: Vec3 = (0.0, 0.0, 0.0)
        self.rate_out: Vec3 = (0.0, 0.0, 0.0)


class Plant:
    """The body, and the walls, posts and ground that it can touch.

    Args:
        obstacles: walls and posts in the mission frame. The vehicle's centre lies on a wall's plane at the
            first touch.
        frame: the mission frame in local NED.
        scatter_seed: seed of the random differences between the coefficients of different contacts.
    """

    def __init__(
        self,
        vehicle: VehicleConfig,
        obstacles: Sequence[Wall | Post],
        frame: MissionFrame,
        start_ned: Vec3 = (0.0, 0.0, 0.0),
        scatter_seed: int = 0,
    ) -> None:
        self.vehicle, self.frame, self.motors = vehicle, frame, vehicle.airframe.motors
        self.mass = vehicle.airframe.mass_kg
        self.time_s = 0.0
        self.position: Vec3 = start_ned
        self.velocity: Vec3 = (0.0, 0.0, 0.0)
        self.q: Quaternion = quaternion_from_euler(0.0, 0.0, 0.0)
        self.rate: Vec3 = (0.0, 0.0, 0.0)
        self.motor: list[float] = [0.0] * len(self.motors)
        self.ground_down = start_ned[2]
        self.mode = vehicle.modes[-1]  # arms with a lock are initially unlocked
        self.wind_ned: Vec3 = (0.0, 0.0, 0.0)
        self.contact_force_ned: Vec3 = (0.0, 0.0, 0.0)  # walls' force at the end of the last step
        self.contact_torque_frd: Vec3 = (0.0, 0.0, 0.0)  # walls' torque about the centre of mass
        self.body = vehicle.simulation.contact
        if self.body.body is BodyModel.POINT:
            self.body = msgspec.structs.replace(
                self.body, guard_out_m=0.0, vertical_lever_m=0.0, fold_share=0.0
            )
        self._law = GuardLaw(Onset(vehicle.onset), vehicle.vertical_force_sign, self.body.vertical_lever_m)
        self._half_engaged = self.body.half_engaged and vehicle.has_lock
        self._rng = random.Random(scatter_seed)
        self._scattered: dict[str, tuple[float, float, float]] = {}
        self._guards = propeller_guards(self.body)
        self._reach_m = max(norm(guard.at) for guard in self._guards)
        walls = (one for one in obstacles if isinstance(one, Wall))
        self.planes = [_plane(wall, frame, self.body.guard_out_m, self._guards) for wall in walls]
        # A point body represents the vehicle's side, at walls and at posts.
        out_m = vehicle.airframe.contact_distance_m - self.body.guard_out_m
        posts = (one for one in obstacles if isinstance(one, Post))
        self.posts = [_standing_post(post, frame, out_m, self._guards) for post in posts]
        self.on_ground = True
        self.finished: list[TruthContact] = []
        self.time_offset_us = 0
        self._open: dict[str, _OpenContact] = {}
        self._faces: tuple[WallWithEnds, ...] = ()  # surfaces of the walls near the vehicle
        vibration = vehicle.simulation.arm_vibration
        self._arm = _AT_REST
        # Copy the constants that every step uses: reading a nested attribute takes as long as a
        # multiplication.
        self._arm_spring = self._arm_damper = self._arm_share = 0.0
        if vibration is not None:
            omega = 2.0 * math.pi * vibration.frequency_hz
            self._arm_spring, self._arm_damper = -omega * omega, 2.0 * vibration.damping_ratio * omega
            self._arm_share = vibration.mass_fraction
        self._full_scale = vehicle.imu.full_scale_m_s2
        self._thrust, self._curve = vehicle.thrust, vehicle.thrust.curve
        self._inertia, self._drag_per_s = vehicle.airframe.inertia_kg_m2, vehicle.airframe.drag_per_s
        self._sensed: Vec3 = (0.0, 0.0, -GRAVITY_M_S2)
        lever = vehicle.simulation.imu_position_m
        self._imu_lever: Vec3 | None = lever if any(lever) else None
        # First-order low-pass: the fraction of the difference between input and output that remains after one
        # step, and this fraction's mean over the step.
        steps_per_lag = 2.0 * math.pi * vehicle.imu.antialias_hz * STEP_S
        self._antialias_decay = math.exp(-steps_per_lag)
        self._antialias_mean = (1.0 - self._antialias_decay) / steps_per_lag
        self._straight = [(motor.x_m, motor.y_m, motor.yaw_torque_per_thrust_m) for motor in self.motors]
        self._arm_of_motor = [arm_of(motor.x_m, motor.y_m) for motor in self.motors]
        self._folded: tuple[float, float, float, float] | None = None
        self._motor_decay = math.exp(-STEP_S / max(vehicle.thrust.motor_lag_s, 1e-4))

    # -- one step --

    def advance(self, motor_commands: Sequence[float], steps: int = 1) -> Vec3:
        """Advance by `steps` milliseconds; return the IMU's mean specific force, FRD, m/s2, without noise.

        The force includes the arms' vibration. In each millisecond the force passes the anti-alias filter and
        is limited to full scale.
        """
        fx = fy = fz = 0.0
        most = self._full_scale
        keep, mean = self._antialias_decay, self._antialias_mean
        near = self._wall_in_reach(steps * STEP_S)
        ox, oy, oz = self._sensed
        for _ in range(steps):
            rate = self.rate
            force = self._advance_one(motor_commands, near)
            nx, ny, nz = rotate_back(self.q, force)
            if self._imu_lever is not None:
                nx, ny, nz = add((nx, ny, nz), _acceleration_at(self._imu_lever, rate, self.rate))
            dx, dy, dz = ox - nx, oy - ny, oz - nz
            ox, oy, oz = nx + keep * dx, ny + keep * dy, nz + keep * dz
            x, y, z = nx + mean * dx, ny + mean * dy, nz + mean * dz
            fx += x if -most < x < most else math.copysign(most, x)
            fy += y if -most < y < most else math.copysign(most, y)
            fz += z if -most < z < most else math.copysign(most, z)
        self._sensed = (ox, oy, oz)
        return (fx / steps, fy / steps, fz / steps)

    def _advance_one(self, commands: Sequence[float], near: bool) -> Vec3:
        thrust_n, torque = self._motors(commands)
        ux, uy, uz = body_up(self.q)
        dx, dy, dz = self._drag()
        m = self.mass
        pushed = (ux * thrust_n / m + dx, uy * thrust_n / m + dy, uz * thrust_n / m + dz)
        obstacles = self._obstacles_near() if near else []
        near_ground = self.position[2] > self.ground_down - _GROUND_M
        if obstacles:
            self._faces = tuple(one.ends for one, _ in obstacles if isinstance(one, _WallPlane))
            touchable = [one for one in obstacles if self._may_touch(*one)]
            contact = self._collide(pushed, torque, touchable, near_ground)
            self._folded = self._fold()
        else:
            self._folded = None
            contact = self._move_on_ground(pushed) if near_ground else self._move_freely(pushed)
            self._rotate_body(torque)
        self.time_s += STEP_S
        sx, sy = self._arm_vibration(contact)
        return (pushed[0] + contact[0] + sx, pushed[1] + contact[1] + sy, pushed[2] + contact[2])

    def _motors(self, commands: Sequence[float]) -> tuple[float, Vec3]:
        k, before, curve = self._motor_decay, self.motor, self._curve
        levers = self._straight if self._folded is None else self._folded_levers(self._folded)
        motor: list[float] = []
        thrust = roll = pitch = yaw = 0.0
        for i, (x, y, drag) in enumerate(levers):
            to = commands[i]
            u = to + (before[i] - to) * k
            motor.append(u)
            force = curve.force_n(u) if curve is not None else self._thrust.force_n(u)
            thrust += force
            roll -= y * force
            pitch += x * force
            yaw += drag * force
        self.motor = motor
        return thrust, (roll, pitch, yaw)

    def _folded_levers(self, folded: tuple[float, float, float, float]) -> list[Vec3]:
        """Return (x, y, yaw torque per thrust) of every motor."""
        levers = []
        for (x, y, yaw_m), arm in zip(self._straight, self._arm_of_motor, strict=True):
            c, s = math.cos(folded[arm]), math.sin(folded[arm])
            levers.append((c * x - s * y, s * x + c * y, yaw_m))
        return levers

    def _drag(self) -> Vec3:
        bx, by, bz = self._drag_per_s
        (vn, ve, vd), (wn, we, wd) = self.velocity, self.wind_ned
        n, e, down = vn - wn, ve - we, vd - wd
        # `vector_from_ned` and `vector_to_ned` of the mission frame, written out for speed.
        c, s = self.frame.cos, self.frame.sin
        x, y = -bx * (n * c + e * s), -by * (n * s - e * c)
        return (x * c + y * s, x * s - y * c, -bz * down)

    def _rotate_body(self, torque: Vec3) -> None:
        ix, iy, iz = self._inertia
        p, q, r = self.rate
        if self.on_ground:
            torque = self._landing_gear_torque(torque)
        roll, pitch, yaw = torque
        gx, gy, gz = gyroscopic_torque(self._inertia, self.rate)
        self.rate = (
            p + STEP_S * (roll - gx) / ix,
            q + STEP_S * (pitch - gy) / iy,
            r + STEP_S * (yaw - gz) / iz,
        )
        self.q = integrate_rate(self.q, self.rate, STEP_S)

    def _landing_gear_torque(self, torque: Vec3) -> Vec3:
        """Add the torque of the landing gear, which levels a resting vehicle and stops its rotation."""
        down = rotate_back(self.q, (0.0, 0.0, 1.0))
        k, c = 3.0, 0.3  # N m/rad and N m s/rad: stiff and well damped for 0.0125 kg m2
        return (
            torque[0] - k * down[1] - c * self.rate[0],
            torque[1] + k * down[0] - c * self.rate[1],
            torque[2] - c * self.rate[2],
        )

    # -- translation and contact --

    def _wall_in_reach(self, seconds: float) -> bool:
        """Return whether the vehicle may be near a wall or post within `seconds`.

        `advance` calls this once for all steps.
        """
        (px, py, _), (vx, vy, _) = self.position, self.velocity
        slack = seconds * (abs(vx) + abs(vy) + _GAIN_M_S)
        for plane in self.planes:
            n, o = plane.normal, plane.point
            if _BEHIND_M - slack < n[0] * (px - o[0]) + n[1] * (py - o[1]) < _NEAR_WALL_M + slack:
                return True
            plane.away = True
        return any(self._clear_of_post_m(post) < _NEAR_WALL_M + slack for post in self.posts)

    def _clear_of_post_m(self, post: _StandingPost) -> float:
        """Return a lower bound of the distance from a post, valid at any attitude."""
        cylinder, p = post.contact.contact.cylinder, self.position
        distance = math.hypot(p[0] - cylinder.axis[0], p[1] - cylinder.axis[1])
        return distance - cylinder.radius_m - self._reach_m

    def _obstacles_near(self) -> list[tuple[_Obstacle, Coefficients]]:
        found: list[tuple[_Obstacle, Coefficients]] = []
        for plane in self.planes:
            coefficients = self._coefficients_near(plane)
            if coefficients is not None:
                found.append((plane, coefficients))
        for post in self.posts:
            if self._clear_of_post_m(post) < _NEAR_WALL_M:
                near = post.contact.nearest(self.q, self.position)
                found.append((post, self._coefficients_of_cylinder(post, post.contact.contact, near)))
        return found

    def _may_touch(self, obstacle: _Obstacle, c: Coefficients) -> bool:
        """Return whether a contact may continue or begin (k x + f vx = 0, `contact.law`) in the next step."""
        if obstacle.name in self._open:
            return True
        v = self.velocity
        turning = norm(self.rate) * self._reach_m
        within_s = STEP_S + c.lead_s
        if isinstance(obstacle, _WallPlane) and obstacle.near_end:
            edges = (edge.coefficients for edge in obstacle.ends.edges)
            within_s = STEP_S + max(c.lead_s, *(one.lead_s for one in edges if one is not None))
            within_m = within_s * (norm(v) + turning + _GAIN_M_S)
            return obstacle.ends.may_touch(self.q, self.position, within_m, self._faces)
        if isinstance(obstacle, _WallPlane):
            n = obstacle.normal
            x = clearance_m(self._guards, self.q, obstacle.ends.plane, self.position)
        else:
            near = obstacle.contact.nearest(self.q, self.position)
            n, x = near.normal, near.x_m
        closing = max(0.0, -(n[0] * v[0] + n[1] * v[1])) + turning + _GAIN_M_S
        return x < within_s * closing

    def _collide(
        self,
        pushed: Vec3,
        torque: Vec3,
        obstacles: list[tuple[_Obstacle, Coefficients]],
        near_ground: bool,
    ) -> Vec3:
        """Move and rotate the body near walls and posts; return the mean acceleration due to contact, NED.

        The integration uses the midpoint rule over position, velocity, attitude and rate. The steps are
        0.1 ms long, and shorter near a wall's end. Thrust and drag are constant during a call (1 ms).
        """
        free = (pushed[0], pushed[1], pushed[2] + GRAVITY_M_S2)
        ends = any(isinstance(obstacle, _WallPlane) and obstacle.near_end for obstacle, _ in obstacles)
        steps = _END_STEPS if ends else CONTACT_STEPS
        h = STEP_S / steps
        g = 0.5 * h
        before = self.velocity
        if near_ground and self.on_ground:
            torque = self._landing_gear_torque(torque)
        self.on_ground = False
        p, v, q, w = self.position, self.velocity, self.q, self.rate
        motion = BodyMotion(p, v, q, w)
        a, b, touches = self._contact_accelerations(motion, free, torque, obstacles, near_ground)
        for i in range(steps):
            mid_p = (p[0] + g * v[0], p[1] + g * v[1], p[2] + g * v[2])
            mid_v = (v[0] + g * a[0], v[1] + g * a[1], v[2] + g * a[2])
            mid_w = (w[0] + g * b[0], w[1] + g * b[1], w[2] + g * b[2])
            motion = BodyMotion(mid_p, mid_v, advance_attitude(q, w, g), mid_w)
            a, b, _ = self._contact_accelerations(motion, free, torque, obstacles, near_ground)
            v_before = v
            self.position = p = (p[0] + h * mid_v[0], p[1] + h * mid_v[1], p[2] + h * mid_v[2])
            self.velocity = v = (v[0] + h * a[0], v[1] + h * a[1], v[2] + h * a[2])
            self.rate = w = (w[0] + h * b[0], w[1] + h * b[1], w[2] + h * b[2])
            self.q = q = integrate_rate(q, mid_w, h)
            # These forces act at the end of this step and at the beginning of the next step.
            motion = BodyMotion(p, v, q, w)
            a, b, touches = self._contact_accelerations(motion, free, torque, obstacles, near_ground)
            for (obstacle, c), one in zip(obstacles, touches, strict=True):
                self._note_contact(obstacle, c, one, self.time_s + i * h, v_before)
        return (
            (v[0] - before[0]) / STEP_S - free[0],
            (v[1] - before[1]) / STEP_S - free[1],
            (v[2] - before[2]) / STEP_S - free[2],
        )

    def _fold(self) -> tuple[float, float, float, float] | None:
        """Return the fold angle of each arm (`propeller_guards.fold_angles`), or None if no arm is folded."""
        touched = [current for current in self._open.values() if current.start.fold_share > 0.0]
        if not touched:
            return None
        angles = [0.0, 0.0, 0.0, 0.0]
        levers = [rotate(self.q, guard.at) for guard in self._guards]
        for current in touched:
            obstacle = current.start.obstacle
            depths = obstacle.depths
            if depths is None and isinstance(obstacle, _WallPlane):
                n, o = obstacle.normal, obstacle.ends.plane.point
                depth = sum_in_order(n[i] * (o[i] - self.position[i]) for i in range(3))
                depths = [max(0.0, depth - n[0] * r[0] - n[1] * r[1] - n[2] * r[2]) for r in levers]
            swung = fold_angles(self.body, current.start.fold_share, depths or ())
            angles = [a + b for a, b in zip(angles, swung, strict=True)]
        return (angles[0], angles[1], angles[2], angles[3])

    def _fold_share(self, incidence: float) -> float:
        """Return an arm's movement as a fraction of its guard's penetration; `incidence` is in radians."""
        if abs(incidence) >= math.radians(self.vehicle.airframe.incidence_rigid_deg):
            return 0.0
        return self.body.fold_share * self._arm_freedom()

    def _arm_freedom(self) -> float:
        """Return 1 if the arms are unlocked, 0 if locked, 0.5 with half-engaged rods."""
        if self.mode is Mode.FLEXIBLE:
            return 1.0
        return _HALF_ENGAGED if self._half_engaged else 0.0

    def _contact_accelerations(
        self,
        motion: BodyMotion,
        free: Vec3,
        torque: Vec3,
        obstacles: list[tuple[_Obstacle, Coefficients]],
        near_ground: bool,
    ) -> tuple[Vec3, Vec3, list[WallLoad]]:
        """Return acceleration (NED), angular acceleration (FRD), and each obstacle's `WallLoad`."""
        force = turned = _NO_FORCE
        touches = []
        for obstacle, c in obstacles:
            if not isinstance(obstacle, _WallPlane):
                one = obstacle.contact.touch(c, motion, self._law)
            elif obstacle.near_end:
                one = obstacle.ends.touch(c, motion, self._law, self._faces)
            else:
                one = touch(self._guards, c, obstacle.ends.plane, motion, self._law)
            touches.append(one)
            if one is not _NO_LOAD:
                force, turned = add(force, one.force), add(turned, one.torque)
        self.contact_force_ned, self.contact_torque_frd = force, turned
        if near_ground:
            force = add(force, self._ground_force(motion.position, motion.velocity))
        m, (ix, iy, iz) = self.mass, self._inertia
        acceleration = (free[0] + force[0] / m, free[1] + force[1] / m, free[2] + force[2] / m)
        roll, pitch, yaw = subtract(add(torque, turned), gyroscopic_torque(self._inertia, motion.rate_frd))
        return acceleration, (roll / ix, pitch / iy, yaw / iz), touches

    def _move_on_ground(self, pushed: Vec3) -> Vec3:
        """Move the centre of mass without walls or posts; return the mean acceleration by the ground, NED."""
        self.contact_force_ned = self.contact_torque_frd = _NO_FORCE
        free = (pushed[0], pushed[1], pushed[2] + GRAVITY_M_S2)
        h = STEP_S / _GROUND_STEPS
        g = 0.5 * h
        before = self.velocity
        for _ in range(_GROUND_STEPS):
            p, v = self.position, self.velocity
            a = self._ground_acceleration(p, v, free)
            mid_p = (p[0] + g * v[0], p[1] + g * v[1], p[2] + g * v[2])
            mid_v = (v[0] + g * a[0], v[1] + g * a[1], v[2] + g * a[2])
            a = self._ground_acceleration(mid_p, mid_v, free)
            self.position = (p[0] + h * mid_v[0], p[1] + h * mid_v[1], p[2] + h * mid_v[2])
            self.velocity = (v[0] + h * a[0], v[1] + h * a[1], v[2] + h * a[2])
        v = self.velocity
        return (
            (v[0] - before[0]) / STEP_S - free[0],
            (v[1] - before[1]) / STEP_S - free[1],
            (v[2] - before[2]) / STEP_S - free[2],
        )

    def _ground_acceleration(self, p: Vec3, v: Vec3, free: Vec3) -> Vec3:
        x, y, z = self._ground_force(p, v)
        m = self.mass
        return (free[0] + x / m, free[1] + y / m, free[2] + z / m)

    def _move_freely(self, pushed: Vec3) -> Vec3:
        """Move the centre of mass without contact; return zero as the acceleration due to contact."""
        self.on_ground = False
        self.contact_force_ned = self.contact_torque_frd = _NO_FORCE
        if self._open:
            self._end_open_contacts()
        (x, y, z), (vx, vy, vz), (ax, ay, az) = self.position, self.velocity, pushed
        az += GRAVITY_M_S2
        h, g = STEP_S, 0.5 * STEP_S
        self.position = (x + h * (vx + g * ax), y + h * (vy + g * ay), z + h * (vz + g * az))
        self.velocity = (vx + h * ax, vy + h * ay, vz + h * az)
        return _NO_FORCE

    def _coefficients_near(self, plane: _WallPlane) -> Coefficients | None:
        """Return the coefficients of a wall's surface, or None if the vehicle cannot touch the wall."""
        position = self.frame.point_from_ned(self.position)
        wall, reach_m = plane.wall, self._reach_m + _NEAR_END_M
        near = _BEHIND_M < wall.signed_distance(position) < _NEAR_WALL_M
        inside_m = wall.end_distance_m(position) if near else -math.inf
        if inside_m < -reach_m:
            plane.away = True
            return None
        if plane.away:
            plane.ends.reset_contacts(self.q, self.position)
            plane.away = False
        plane.near_end = inside_m < reach_m or not plane.ends.is_plain
        yaw = self.frame.yaw_from_ned(yaw_ned_of(self.q))
        c = self._coefficients(plane, wall.incidence(yaw))
        if not plane.near_end:
            plane.ends.bearing.clear()  # `touch` on a surface without ends does not update `bearing`
        else:
            for edge, nearest in plane.ends.nearest(self.q, self.position):
                self._coefficients_of_cylinder(plane, edge, nearest)
        return c

    def _coefficients_of_cylinder(
        self, obstacle: _Obstacle, contact: CylinderContact, near: NearestPoint
    ) -> Coefficients:
        """Return the coefficients at `near`, the cylinder's point nearest to the vehicle.

        They stay constant during a contact.
        """
        c = contact.coefficients
        if c is None or contact.share is None:
            c = contact.coefficients = self._coefficients(obstacle, abs(self._incidence(near.normal)))
        return c

    def _incidence(self, normal: Vec3) -> float:
        """Return the signed angle of incidence on a surface with this normal (NED), radians.

        The angle is 0 if one of the vehicle's four sides is parallel to the surface.
        """
        x, y, _ = self.frame.vector_from_ned(normal)
        turn = self.frame.yaw_from_ned(yaw_ned_of(self.q)) - math.atan2(-y, -x)
        return wrap_angle(turn - _QUARTER * round(turn / _QUARTER))

    def _coefficients(self, obstacle: _Obstacle, incidence: float) -> Coefficients:
        open_contact = self._open.get(obstacle.name)
        if open_contact is not None:
            # Rods and arms do not change while they are loaded: keep the initial values.
            return open_contact.start.coefficients
        c = coefficients_in_force(self.vehicle, obstacle.material, self.mode, incidence)
        if self._half_engaged and self.mode is Mode.RIGID:
            flexible = coefficients_in_force(self.vehicle, obstacle.material, Mode.FLEXIBLE, incidence)
            c = _between(c, flexible)
        if self.body.scatter:
            k, f, mu = self._scattered.setdefault(obstacle.name, self._scatter())
            c = c.scaled(k, f, mu)
        return c

    def _scatter(self) -> tuple[float, float, float]:
        """Draw the factors on k, f and mu for the next contact with an obstacle."""
        factors = [max(0.1, 1.0 + self.body.scatter * self._rng.gauss(0.0, 1.0)) for _ in range(3)]
        return (factors[0], factors[1], factors[2])

    def _ground_force(self, p: Vec3, v: Vec3) -> Vec3:
        """Return the ground's force: a spring and damper, and regularised Coulomb friction."""
        s = self.vehicle.simulation
        depth = p[2] - self.ground_down
        normal = s.ground_stiffness_n_m * depth + s.ground_damping_n_s_m * v[2]
        self.on_ground = depth > 0.0 and normal > 0.0
        if not self.on_ground:
            return (0.0, 0.0, 0.0)
        speed = math.hypot(v[0], v[1])
        grip = GROUND_FRICTION * normal / math.hypot(speed, _GROUND_SPEED_M_S)
        return (-grip * v[0], -grip * v[1], -normal)

    def _note_contact(
        self, obstacle: _Obstacle, c: Coefficients, reaction: WallLoad, t_s: float, velocity_before: Vec3
    ) -> None:
        """Track the contact with one obstacle from the first force to the last force."""
        current = self._open.get(obstacle.name)
        if reaction.normal_n > 0.0:
            if current is None:
                current = self._begin_contact(obstacle, c, reaction.normal, t_s, velocity_before)
            current.peak_normal = max(current.peak_normal, reaction.normal_n)
            current.peak_friction = max(current.peak_friction, abs(reaction.friction_n))
            current.peak_torque = max(current.peak_torque, norm(reaction.torque))
            current.last_s, current.velocity_out, current.rate_out = t_s, self.velocity, self.rate
        elif current is not None and t_s - current.last_s > _REBOUND_S:
            self._end_contact(current)

    def _begin_contact(
        self, obstacle: _Obstacle, c: Coefficients, normal: Vec3, t_s: float, velocity_before: Vec3
    ) -> _OpenContact:
        n, t, incidence = normal, (-normal[1], normal[0], 0.0), self._incidence(normal)
        if isinstance(obstacle, _WallPlane):
            if n is obstacle.normal:
                yaw = self.frame.yaw_from_ned(yaw_ned_of(self.q))
                t, incidence = obstacle.tangent, wrap_angle(yaw - obstacle.wall.parallel_yaw(yaw))
            else:
                c = obstacle.ends.coefficients or c
        start = _ContactStart(
            obstacle=obstacle,
            mode=self.mode,
            coefficients=c,
            start_s=t_s,
            normal=n,
            tangent=t,
            normal_in=n[0] * velocity_before[0] + n[1] * velocity_before[1],
            tangential_in=t[0] * velocity_before[0] + t[1] * velocity_before[1],
            position=self.frame.point_from_ned(self.position),
            incidence=incidence,
            tilt=tilt_of(self.q),
            fold_share=self._fold_share(incidence),
        )
        current = _OpenContact(start)
        self._open[obstacle.name] = current
        return current

    def _end_open_contacts(self) -> None:
        """End all open contacts at the times of their last forces, because no obstacle is near."""
        for current in list(self._open.values()):
            self._end_contact(current)

    def _end_contact(self, current: _OpenContact) -> None:
        name = current.start.obstacle.name
        del self._open[name]
        self._scattered.pop(name, None)
        n, t = current.start.normal, current.start.tangent
        v = current.velocity_out
        self.finished.append(
            TruthContact(
                t_us=self._stamp(current.start.start_s),
                end_us=self._stamp(current.last_s),
                wall=name,
                mode=current.start.mode,
                normal_in_m_s=current.start.normal_in,
                tangential_in_m_s=current.start.tangential_in,
                normal_out_m_s=n[0] * v[0] + n[1] * v[1],
                tangential_out_m_s=t[0] * v[0] + t[1] * v[1],
                peak_normal_force_n=current.peak_normal,
                peak_friction_force_n=current.peak_friction,
                position_mission=current.start.position,
                incidence_rad=current.start.incidence,
                tilt_rad=current.start.tilt,
                rate_out_frd=current.rate_out,
                lead_m=2.0 * self.body.guard_along_m * math.sin(current.start.incidence),
                peak_torque_nm=current.peak_torque,
            )
        )

    def _arm_vibration(self, contact: Vec3) -> Vec2:
        """Return the acceleration of the body relative to the centre of mass, NED.

        Arms and body vibrate against each other. The vibration moves the IMU but not the centre of mass, so
        the contact force does not depend on it. Let q be the arms' displacement relative to the body, s the
        arms' fraction of the mass, w the natural frequency (rad/s), zeta the damping ratio, and c the
        acceleration due to the contact. The body's displacement from the centre of mass is -s q. With q'' =
        -w^2 q - 2 zeta w q' - c, the IMU measures the additional acceleration -s q''.
        """
        freedom = self._arm_freedom() if self._arm_share else 0.0
        if freedom == 0.0:
            self._arm = _AT_REST
            return (0.0, 0.0)
        spring, damper = self._arm_spring, self._arm_damper
        qx, qy, vx, vy = self._arm
        ax = spring * qx - damper * vx - contact[0]
        ay = spring * qy - damper * vy - contact[1]
        vx, vy = vx + STEP_S * ax, vy + STEP_S * ay
        self._arm = (qx + STEP_S * vx, qy + STEP_S * vy, vx, vy)
        share = freedom * self._arm_share
        return (-share * ax, -share * ay)

    # -- truth --

    def _stamp(self, t_s: float) -> int:
        return round(t_s * 1e6) + self.time_offset_us

    @property
    def in_contact(self) -> bool:
        return bool(self._open)

    def set_mode(self, mode: Mode) -> None:
        """Unlock the arms, or lock them if no contact is open: a rod cannot enter a folded arm's slot."""
        if mode is Mode.RIGID and self._open:
            return
        self.mode = mode

    def truth(self) -> TruthSample:
        return TruthSample(
            t_us=self._stamp(self.time_s),
            position_mission=self.frame.point_from_ned(self.position),
            velocity_mission=self.frame.vector_from_ned(self.velocity),
            contact_force_mission=self.frame.vector_from_ned(self.contact_force_ned),
            q_frd_to_ned=self.q,
            mode=self.mode,
            contact_torque_frd=self.contact_torque_frd,
        )


def make_plant(mission: Mission, seed: int = 0) -> Plant:
    """Return the vehicle on the ground below a mission's start; arms with a lock are unlocked."""
    flat = mission.frame_at((0.0, 0.0, 0.0))
    x, y = mission.start
    start_ned = flat.point_to_ned((x, y, 0.0))
    return Plant(
        mission.vehicle,
        (*mission.flat_walls, *mission.simulated_walls, *mission.posts),
        mission.frame_at(start_ned),
        start_ned,
        seed,
    )


def _acceleration_at(lever: Vec3, before: Vec3, after: Vec3) -> Vec3:
    """Return the acceleration of a point relative to the centre of mass, FRD.

    With lever r, body rate w and angular acceleration alpha, the result is alpha x r + w x (w x r).
    """
    rx, ry, rz = lever
    ax, ay, az = ((b - a) / STEP_S for a, b in zip(before, after, strict=True))
    wx, wy, wz = (0.5 * (a + b) for a, b in zip(before, after, strict=True))
    along, square = wx * rx + wy * ry + wz * rz, wx * wx + wy * wy + wz * wz
    return (
        ay * rz - az * ry + wx * along - square * rx,
        az * rx - ax * rz + wy * along - square * ry,
        ax * ry - ay * rx + wz * along - square * rz,
    )


def _between(a: Coefficients, b: Coefficients) -> Coefficients:
    """Return the coefficients for half-engaged rods: the geometric mean of both modes."""
    return Coefficients(
        math.sqrt(a.k * b.k), math.sqrt(a.f * b.f), math.sqrt(a.mu * b.mu), math.sqrt(a.nu * b.nu)
    )


def _plane(wall: Wall, frame: MissionFrame, out_m: float, guards: Sequence[PropellerGuard]) -> _WallPlane:
    """Convert a wall to NED; its surface is `out_m` behind the vehicle's centre at the first touch."""
    point = frame.point_to_ned((wall.point[0], wall.point[1], 0.0))
    normal = frame.vector_to_ned(wall.from_collision((1.0, 0.0, 0.0)))
    tangent = frame.vector_to_ned(wall.from_collision((0.0, 1.0, 0.0)))
    down = frame.vector_to_ned(wall.from_collision((0.0, 0.0, 1.0)))
    on_surface = (
        point[0] - out_m * normal[0],
        point[1] - out_m * normal[1],
        point[2] - out_m * normal[2],
    )
    surface = Plane(on_surface, normal, tangent, down, 0.5 * wall.length_m)
    edge_m = max(0.0, min(EDGE_RADIUS_M, wall.behind_m - out_m))  # a thin partition has a rounded end
    return _WallPlane(wall, point, normal, tangent, WallWithEnds(surface, guards, edge_m))


def _standing_post(
    post: Post, frame: MissionFrame, out_m: float, guards: Sequence[PropellerGuard]
) -> _StandingPost:
    """Convert a post to NED, with its radius increased by `out_m`."""
    axis = frame.point_to_ned((post.centre[0], post.centre[1], 0.0))
    return _StandingPost(post, PostContact(Cylinder(axis, max(0.0, post.radius_m + out_m)), guards))
