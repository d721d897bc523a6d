#!/usr/bin/env python3
"""Writes two motions beside this script, as targets of the joints in time: quadruped-trot.csv and humanoid-step.csv.

    python3 robot/models/motions.py                     # the trot alone, with nothing but Python
    python3 -m venv target/truth && target/truth/bin/pip install pin==4.1.0 numpy==2.4.6
    target/truth/bin/python robot/models/motions.py     # both

A file's first line names its columns: time in s, then joints in rad. Between rows targets go in straight lines; after the last row they stay.
They are open loop: nothing is measured. Gains are for tau = kp (target - q) - kd qd in the trot, and kp (target - q) + kd (target's rate - qd) in the step, clamped to
the file's efforts; armature 0.01.
Lengths in m, angles in rad, times in s; x forward, y left, z up.
"""
import csv
import math
from pathlib import Path

HERE = Path(__file__).resolve().parent
STEP = 0.01


def write(name, joints, rows):
    with open(HERE / name, "w", newline="") as f:
        out = csv.writer(f, lineterminator="\n")
        out.writerow(["time", *joints])
        out.writerows([f"{t:.2f}", *(f"{x + 0.0:.5f}" for x in q)] for t, q in rows)
    print(f"{name}: {len(rows)} rows")


# -- Quadruped: trot ---------------------------------------------------------------------------------------------------------------
# Tuned on rigid ground, elastic ground and yielding sand (feet sinking 2 to 11 cm) with kp 250, kd 5: 0.72 m/s on rigid ground, 0.58 on elastic,
# 0.60, 0.50 and 0.45 where feet sink 4, 6 and 11 cm; 0.4 to 0.8 m/s on slopes of 10 degrees. No fall with kp from 150 to 400.

HIP, THIGH, CALF = 0.085, 0.21, 0.21   # from the axis of abduction to the leg's plane; the leg's parts
LEGS = {"FL": 1, "FR": -1, "RL": 1, "RR": -1}
TROT = dict(speed=0.7, frequency=2.3, duty=0.63, lift=0.085, height=0.285, back=0.015, start=0.5, ramp=1.0)


def leg(x, y, z, side):
    """Angles of hip, thigh and calf that put the foot's centre at (x, y, z) from the hip joint; side is 1 left, -1 right."""
    a = HIP * side
    depth = math.sqrt(y * y + z * z - a * a)
    hip = math.atan2(y, -z) - math.atan2(a, depth)
    c = (x * x + depth * depth - THIGH * THIGH - CALF * CALF) / (2 * THIGH * CALF)
    calf = -math.acos(max(-1.0, min(1.0, c)))
    thigh = math.atan2(-x, depth) - math.atan2(CALF * math.sin(calf), THIGH + CALF * math.cos(calf))
    return hip, thigh, calf


def trot(t, speed, frequency, duty, lift, height, back, start, ramp):
    """Targets of the twelve joints: FL and RR together, FR and RL half a period later."""
    targets = []
    for name, side in LEGS.items():
        x = z = 0.0
        if t >= start:
            grown = min(1.0, (t - start) / ramp)
            phase = ((t - start) * frequency + (0.0 if name in ("FL", "RR") else 0.5)) % 1.0
            stride = grown * speed * duty / frequency
            if phase < duty:   # on the ground: back at constant speed
                x = stride * (0.5 - phase / duty)
            else:              # in the air: a cycloid forward, up and down as a cosine
                u = (phase - duty) / (1 - duty)
                x = stride * (u - math.sin(2 * math.pi * u) / (2 * math.pi) - 0.5)
                z = grown * lift * (1 - math.cos(2 * math.pi * u)) / 2
        targets += leg(x - back, side * HIP, z - height, side)
    return targets


# -- Humanoid: a step of 0.2 m -----------------------------------------------------------------------------------------------------
# 1. The centre of mass goes to the left and back as the linear inverted pendulum above the left foot's middle does: no moment on the sole.
# 2. Meanwhile the right foot goes forward; then the centre of mass comes to rest between the feet.
# 3. Legs by closed form, pelvis and feet level. 4. Joint torques by inverse dynamics, the ground's wrench shared by the feet.
# 5. Targets are angles + (torques + kd speeds) / kp, so that the joints follow without an error.
# Tuned on rigid, elastic (E 2e5) and sand-like ground that yields by Terzaghi's formula: without feedback it holds on rigid ground and on sand of 40 degrees and
# more; with the pelvis fed back (README.md) on all but loose sand of 30 degrees.

THIGH_H = CALF_H = 0.30
SIDE, SOLE, MIDDLE = 0.09, 0.06, 0.025   # hips from the middle; ankle above the sole; sole's middle before the ankle
ARMS = [0.15, 0.12, 0, -0.5, 0.15, -0.12, 0, -0.5]
HUMANOID_KP = [400, 600, 600, 600, 600, 600] * 2 + [400] + [100, 100, 50, 100] * 2
HUMANOID_KD = [0.03 * k for k in HUMANOID_KP]
WALK = dict(height=0.63, rest=0.5, shift=0.8, swing=0.4, settle=0.75, step=0.2, lift=0.055, reach=0.0525, press=-0.0035, before=0.03, ahead=0.001, forward=0.035,
            end=0.125, land=0.004, keep=0.7, tail=1.5)


def smooth(u):
    u = max(0.0, min(1.0, u))
    return u * u * u * (10 + u * (-15 + 6 * u))


def humanoid_leg(x, y, z):
    """Angles of hip yaw, roll, pitch, knee, ankle pitch, roll that put the ankle at (x, y, z) from the hip, pelvis and foot level."""
    depth, roll = math.hypot(y, z), math.atan2(y, -z)
    c = (x * x + depth * depth - THIGH_H * THIGH_H - CALF_H * CALF_H) / (2 * THIGH_H * CALF_H)
    knee = math.acos(max(-1.0, min(1.0, c)))
    pitch = math.atan2(-x, depth) - math.atan2(CALF_H * math.sin(knee), THIGH_H + CALF_H * math.cos(knee))
    return [0.0, roll, pitch, knee, -(pitch + knee), -roll]


def humanoid_step(height, rest, shift, swing, settle, step, lift, reach, press, before, ahead, forward, end, land, keep, tail):
    """Names, rows of targets, and the pelvis and angles at the start."""
    import numpy as np
    import pinocchio as pin

    model = pin.buildModelFromUrdf(str(HERE / "humanoid.urdf"), pin.JointModelFreeFlyer())
    data, names = model.createData(), list(model.names)[2:]
    soles = [model.getFrameId(s + "_foot", pin.FrameType.BODY) for s in ("left", "right")]

    def full(pelvis, q):
        return np.concatenate([pelvis, [0, 0, 0, 1], q])

    def angles(pelvis, left, right):
        return np.array(humanoid_leg(*(left - pelvis - [0, SIDE, 0])) + humanoid_leg(*(right - pelvis + [0, SIDE, 0])) + [0.0] + ARMS)

    def above(x, y, left, right):
        """Pelvis and angles with the centre of mass above (x, y)."""
        pelvis = np.array([x, y, height])
        for _ in range(8):
            q = angles(pelvis, left, right)
            pelvis[:2] -= pin.centerOfMass(model, data, full(pelvis, q))[:2] - [x, y]
        return pelvis, angles(pelvis, left, right)

    def joining(T, p0, v0, a0, p1, v1, a1):
        """Polynomial of fifth degree with these ends."""
        M = [[1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 2, 0, 0, 0], [1, T, T**2, T**3, T**4, T**5], [0, 1, 2 * T, 3 * T**2, 4 * T**3, 5 * T**4],
             [0, 0, 2, 6 * T, 12 * T**2, 20 * T**3]]
        return np.polynomial.Polynomial(np.linalg.solve(M, [p0, v0, a0, p1, v1, a1]))

    # The pendulum above the left foot: y = side - a cosh(w (t - swing / 2)), x = before + ahead cosh(w t) + forward / w sinh(w t).
    w = math.sqrt(9.81 / (height + 0.047))
    pivot = SIDE + press
    a = pivot - reach
    y0, v0 = pivot - a * math.cosh(w * swing / 2), a * w * math.sinh(w * swing / 2)
    C, S = math.cosh(w * swing), math.sinh(w * swing)
    x1, u1 = ahead * C + forward / w * S, ahead * w * S + forward * C
    to_y, from_y = joining(shift, 0, 0, 0, y0, v0, w * w * (y0 - pivot)), joining(settle, y0, -v0, w * w * (y0 - pivot), 0, 0, 0)
    to_x, from_x = joining(shift, before, 0, 0, before + ahead, forward, w * w * ahead), joining(settle, before + x1, u1, w * w * x1, end, 0, 0)
    up, down = rest + shift, rest + shift + swing
    times = np.arange(0, down + settle + tail, STEP)
    plan, weights = [], []
    for t in times:
        x, y, zmp = before, 0.0, 0.0
        if rest <= t < up:
            s = t - rest
            x, y = to_x(s), to_y(s)
            zmp = y - to_y.deriv(2)(s) / w**2
        elif up <= t < down:
            s = t - up
            x, y, zmp = before + ahead * math.cosh(w * s) + forward / w * math.sinh(w * s), pivot - a * math.cosh(w * (s - swing / 2)), SIDE
        elif t >= down:
            s = min(t - down, settle)
            x, y = from_x(s), from_y(s)
            zmp = y - from_y.deriv(2)(s) / w**2
        u = (t - up) / swing
        foot = [step * smooth(u), -SIDE, SOLE]
        if 0 < u < 1:
            foot[2] += lift * (1 - math.cos(2 * math.pi * u)) / 2 - land * smooth(2 * u - 1)
        elif u >= 1:   # presses a little, as the other foot has sunk
            foot[2] -= land * (1 - (1 - keep) * smooth((t - down) / settle))
        plan.append(np.concatenate(above(x, y, np.array([0, SIDE, SOLE]), np.array(foot))))
        weights.append(min(1.0, max(0.0, 0.5 + 0.5 * zmp / SIDE)))

    plan = np.array(plan)
    speeds = np.gradient(plan, STEP, axis=0)
    changes = np.gradient(speeds, STEP, axis=0)
    kp, kd, rows = np.array(HUMANOID_KP), np.array(HUMANOID_KD), []
    for t, X, V, A, left in zip(times, plan, speeds, changes, weights):
        at = full(X[:3], X[3:])
        tau = pin.rnea(model, data, at, np.insert(V, 3, [0, 0, 0]), np.insert(A, 3, [0, 0, 0])).copy()
        pin.framesForwardKinematics(model, data, at)
        shares, feet = (left, 1 - left), [data.oMf[i].translation.copy() for i in soles]
        force = tau[:3].copy()
        moment = tau[3:6] + np.cross(X[:3], force) - sum(s * np.cross(p, force) for s, p in zip(shares, feet))
        for s, i in zip(shares, soles):
            J = pin.computeFrameJacobian(model, data, at, i, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            tau -= s * J.T @ np.concatenate([force, moment])
        rows.append((t, X[3:] + (tau[6:] + kd * V[3:]) / kp))
    return names, with_rates(rows, 0.03), plan[0]


def with_rates(rows, delay):
    """Targets that do with a damping against their own rate what `rows` do with one against rest: new + delay d(new)/dt = old, delay = kd / kp."""
    new = [rows[0][1]]
    for (_, a), (_, b) in zip(rows, rows[1:]):
        new.append(((a + b) / 2 - new[-1] * (0.5 - delay / STEP)) / (0.5 + delay / STEP))
    return [(t, q) for (t, _), q in zip(rows, new)]


def main():
    joints = [f"{leg}_{part}_joint" for leg in LEGS for part in ("hip", "thigh", "calf")]
    times = [i * STEP for i in range(round(8 / STEP) + 1)]
    write("quadruped-trot.csv", joints, [(t, trot(t, **TROT)) for t in times])
    try:
        names, rows, start = humanoid_step(**WALK)
    except ModuleNotFoundError as e:
        print(f"humanoid-step.csv left as it is: {e}")
        return
    write("humanoid-step.csv", names, rows)
    print("humanoid at the start: pelvis", [round(float(x), 5) for x in start[:3]], {n: round(float(x), 5) for n, x in zip(names, start[3:])})


if __name__ == "__main__":
    main()
