#!/usr/bin/env python3
"""Writes truth.json beside this script: what pinocchio says of the robots that the tests load. README.md says what the entries mean.

    python3 -m venv target/truth
    target/truth/bin/pip install pin==4.1.0 example-robot-data==6.0.0 numpy==2.4.6
    target/truth/bin/python tests/robots/truth.py               # a minute
    target/truth/bin/python tests/robots/truth.py --table       # prints the README's table of what the files contain
"""
import importlib.metadata
import json
import math
import re
import sys
import sysconfig
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
PACKAGE = Path(sysconfig.get_path("purelib")) / "cmeel.prefix/share/example-robot-data"
SEED = 24
GRAVITY = 9.81

# name, file, floating, link that is pushed
ROBOTS = [
    ("go2", "example-robot-data/robots/go2_description/urdf/go2.urdf", True, "FL_foot"),
    ("a1", "example-robot-data/robots/a1_description/urdf/a1.urdf", True, "FL_foot"),
    ("anymal_b", "example-robot-data/robots/anymal_b_simple_description/robots/anymal.urdf", True, "LF_FOOT"),
    ("anymal_c", "example-robot-data/robots/anymal_c_simple_description/urdf/anymal.urdf", True, "LF_FOOT"),
    ("solo12", "example-robot-data/robots/solo_description/robots/solo12.urdf", True, "FL_FOOT"),
    ("g1", "example-robot-data/robots/g1_description/urdf/g1_29dof_rev_1_0.urdf", True, "left_ankle_roll_link"),
    ("talos", "example-robot-data/robots/talos_data/robots/talos_reduced.urdf", True, "leg_left_6_link"),
    ("panda", "example-robot-data/robots/panda_description/urdf/panda.urdf", False, "panda_hand"),
    ("ur5", "example-robot-data/robots/ur_description/urdf/ur5_robot.urdf", False, "tool0"),
    ("quadruped", "rigid-couple/models/quadruped.urdf", True, "FL_foot"),
    ("humanoid", "rigid-couple/models/humanoid.urdf", True, "left_foot"),
    ("arm", "rigid-couple/models/arm.urdf", False, "flange"),
    ("arm-rod", "rigid-couple/models/arm-rod.urdf", False, "rod"),
    ("arm-shovel", "rigid-couple/models/arm-shovel.urdf", False, "shovel"),
    ("arm-scraper", "rigid-couple/models/arm-scraper.urdf", False, "scraper"),
    ("double_pendulum", "tests/robots/double_pendulum.urdf", False, "lower"),
]


def place(file):
    name = "example-robot-data/"
    return PACKAGE / file[len(name):] if file.startswith(name) else ROOT / file


def number(x):
    """Nine digits; what is nothing but rounding becomes 0."""
    x = float(x)
    return 0 if abs(x) < 1e-12 else float(f"{x:.9g}")


def numbers(xs):
    return [number(x) for x in np.asarray(xs).ravel()]


def quaternion(R):
    """(w, x, y, z) with w >= 0."""
    c = pin.Quaternion(np.asarray(R)).coeffs()
    w = np.array([c[3], c[0], c[1], c[2]])
    return w if w[0] >= 0 else -w


# -- What a file says, read without pinocchio --------------------------------------------------------------------------------------

def inertia(link):
    """Mass and inertia of a link element, or None."""
    e = link.find("inertial")
    if e is None:
        return None
    m, i = float(e.find("mass").get("value")), e.find("inertia")
    xx, xy, xz, yy, yz, zz = (float(i.get(k, 0)) for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    return m, np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def physical(m, I):
    """What is wrong with a mass and an inertia, or ''."""
    if m == 0 and not I.any():
        return "nothing"
    if m <= 0:
        return "no mass"
    if not I.any():
        return "inertia 0"
    a, b, c = np.linalg.eigvalsh(I)
    if a <= 0:
        return "not positive"
    return "triangle" if a + b < c * (1 - 1e-6) else ""


def contents(file):
    """Counts and flaws of a URDF file, as a dictionary."""
    path = place(file)
    root = ET.parse(path).getroot()
    joints = root.findall("joint")
    kinds = {}
    for j in joints:
        kinds[j.get("type")] = kinds.get(j.get("type"), 0) + 1
    children = {j.find("child").get("link") for j in joints}
    fixed = {j.find("child").get("link") for j in joints if j.get("type") == "fixed"}
    mimic = [{"joint": j.get("name"), "fixed": j.get("type") == "fixed", "of": m.get("joint"), "multiplier": float(m.get("multiplier", 1)), "offset": float(m.get("offset", 0))}
             for j in joints for m in j.findall("mimic")]
    flaws, missing, mass, turned = {}, [], 0.0, 0
    for l in root.findall("link"):
        i = inertia(l)
        if i is None:
            missing.append(l.get("name"))
            continue
        mass += i[0]
        wrong = physical(*i)
        if wrong:
            flaws.setdefault(wrong, []).append(l.get("name"))
        origin = l.find("inertial").find("origin")
        turned += origin is not None and any(abs(float(x)) > 1e-9 for x in origin.get("rpy", "0 0 0").split())
    shapes, meshes = {}, {}
    for part in ("collision", "visual"):
        for l in root.findall("link"):
            for e in l.findall(part):
                for g in e.find("geometry"):
                    shapes.setdefault(part, {}).setdefault(g.tag, 0)
                    shapes[part][g.tag] += 1
                    if g.tag == "mesh":
                        meshes.setdefault(part, []).append((g.get("filename"), g.get("scale")))
    absent, formats, solid = [], {}, []
    for part, names in meshes.items():
        for name, _ in names:
            found = re.sub("^package://example-robot-data/", str(PACKAGE) + "/", name)
            found = Path(found) if found.startswith("/") else path.parent / found
            if not found.is_file():
                absent.append(name)
                continue
            ending = found.suffix.lower()[1:]
            formats.setdefault(part, {}).setdefault(ending, 0)
            formats[part][ending] += 1
            data = found.read_bytes()
            if ending == "stl" and data[:5] == b"solid" and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little"):
                solid.append(found.name)
    top = [l.get("name") for l in root.findall("link") if l.get("name") not in children]
    return {"path": path, "root": top, "links": len(root.findall("link")), "kinds": kinds, "mimic": mimic, "mass": mass, "missing": missing, "fixed": fixed,
            "flaws": flaws, "shapes": shapes, "formats": formats, "absent": sorted(set(absent)), "solid": sorted(set(solid)), "turned": turned,
            "scaled": sorted({s for v in meshes.values() for _, s in v if s and set(s.split()) - {"1", "1.0"}}),
            "schemes": sorted({n.split(":")[0] + "://" if ":" in n else "relative" for v in meshes.values() for n, _ in v})}


def table():
    """The README's table."""
    def few(names):
        return ", ".join(f"`{n}`" for n in names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")

    print("| Robot | links, joints | links without inertia | flawed inertia | turned inertia | mimic | collision | visual | meshes missing, and other |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name, file, _, _ in ROBOTS:
        c = contents(file)
        kinds = ", ".join(f"{n} {k}" for k, n in sorted(c["kinds"].items()))
        moving = [m for m in c["missing"] if m not in c["fixed"] and m not in c["root"]]
        missing = f"{len(c['missing'])}" + (f", {len(moving)} of them moving" if moving else "") + (f", root `{c['root'][0]}`" if c["root"][0] in c["missing"] else "")
        flaws = "; ".join(f"{k}: {few(v)}" for k, v in c["flaws"].items())

        def shape(part):
            s = dict(c["shapes"].get(part, {}))
            f = c["formats"].get(part, {})
            s.pop("mesh", None)
            return ", ".join(f"{n} {k}" for k, n in {**s, **f}.items())
        other = [few(c["absent"])] if c["absent"] else []
        if c["solid"]:
            other.append("binary STL that begins with `solid`: " + few(c["solid"]))
        if c["scaled"]:
            other.append("scale " + few(c["scaled"]))
        idle = sum(m["fixed"] for m in c["mimic"])
        mimic = (f"{len(c['mimic'])}" + (f", {idle} of them on fixed joints" if idle else "")) if c["mimic"] else ""
        print(f"| {name} | {c['links']}: {kinds} | {missing} | {flaws} | {c['turned']} | {mimic} | {shape('collision')} | {shape('visual')} | {'; '.join(other)} |")


# -- Robots ------------------------------------------------------------------------------------------------------------------------

def angles_in(model, names, q):
    """The configuration vector of pinocchio from one number a joint; a continuous joint has its cosine and sine there."""
    for name, x in zip(names, q):
        j = model.joints[model.getJointId(name)]
        if j.nq == 2:
            yield j.idx_q, (math.cos(x), math.sin(x))
        else:
            yield j.idx_q, (x,)


def configuration(model, floating, base, names, q):
    out = pin.neutral(model)
    if floating:
        w = np.array(base[3:]) / np.linalg.norm(base[3:])
        out[:3], out[3:7] = base[:3], (w[1], w[2], w[3], w[0])
    for at, xs in angles_in(model, names, q):
        out[at:at + len(xs)] = xs
    return out


def of_world(M, h, R, v):
    """The bias for a base velocity with world axes: there the base's linear acceleration also holds w x v."""
    h = h.copy()
    h -= M[:, :3] @ np.cross(v[3:6], v[:3])
    h[:3], h[3:6] = R @ h[:3], R @ h[3:6]
    return h


def robot(name, file, floating, pushed, random):
    """1. Names and counts. 2. Three states. 3. For each: places of the links, mass matrix, bias, what a push on one link does to the joints."""
    c = contents(file)
    model = pin.buildModelFromUrdf(str(c["path"]), pin.JointModelFreeFlyer()) if floating else pin.buildModelFromUrdf(str(c["path"]))
    model.gravity.linear = np.array([0, 0, -GRAVITY])
    model.armature = np.zeros(model.nv)
    data = model.createData()
    names = [n for n in model.names if n not in ("universe", "root_joint")]
    first = 6 if floating else 0
    assert model.nv == first + len(names), name
    for body in list(model.inertias)[1:]:
        assert not physical(body.mass, body.inertia), (name, "a body with all that is fixed to it is not physical")
    tree = ET.parse(c["path"]).getroot()
    limits = {}
    for j in tree.findall("joint"):
        l = j.find("limit")
        if j.get("type") == "continuous" or l is None:
            limits[j.get("name")] = (-math.pi, math.pi)
        else:
            limits[j.get("name")] = (max(float(l.get("lower", 0)), -math.pi), min(float(l.get("upper", 0)), math.pi))
    follow = {m["joint"]: m for m in c["mimic"] if m["joint"] in names}

    def obey(x, offset):
        """Lets the joints that mimic follow."""
        for n, m in follow.items():
            x[names.index(n)] = m["multiplier"] * x[names.index(m["of"])] + (m["offset"] if offset else 0)
        return [round(float(a), 6) for a in x]

    states = []
    for k in range(3):
        base, q, v = [0, 0, 0, 1, 0, 0, 0], [0.0] * len(names), [0.0] * model.nv
        if k:
            if floating:
                turn = random.normal(size=4)
                base = [round(float(x), 6) for x in [*random.uniform(-1, 1, 3), *(turn / np.linalg.norm(turn) * np.sign(turn[0]))]]
            q = obey([random.uniform(*limits[n]) for n in names], True)
            v = random.normal(size=model.nv)
            v = [round(float(x), 6) for x in v[:first]] + obey(v[first:], False)
        elif follow:
            q = obey(q, True)
        at, speed = configuration(model, floating, base, names, q), np.array(v)
        M = pin.crba(model, data, at)
        M = np.triu(M) + np.triu(M, 1).T
        h = pin.nonLinearEffects(model, data, at, speed).copy()
        pin.forwardKinematics(model, data, at, speed)
        pin.updateFramePlacements(model, data)
        state = {"base": base} if floating else {}
        state["angles"] = q
        state["links"] = {}
        for f in model.frames:
            if f.type == pin.FrameType.BODY:
                X = data.oMf[model.getFrameId(f.name, pin.FrameType.BODY)]
                state["links"][f.name] = numbers([*X.translation, *quaternion(X.rotation)])
        assert set(state["links"]) == {l.get("name") for l in tree.findall("link")}, name
        state["centre_of_mass"] = numbers(pin.centerOfMass(model, data, at))
        if k < 2:
            state["mass_matrix"] = numbers(M[np.triu_indices(model.nv)])
        if k:
            state["velocity"] = v
            state["bias"] = numbers(h)
            state["kinetic_energy"] = number(0.5 * speed @ M @ speed)
            if floating:
                R = data.oMi[1].rotation
                state["velocity_world"] = numbers([*(R @ speed[:3]), *(R @ speed[3:6]), *speed[6:]])
                state["bias_world"] = numbers(of_world(M, h, R, speed))
            frame = model.getFrameId(pushed, pin.FrameType.BODY)
            J = pin.computeFrameJacobian(model, data, at, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            wrench = np.array([1, 2, 3, 0.1, 0.2, 0.3])
            state["push"] = {"link": pushed, "wrench": wrench.tolist(), "twist": numbers(J @ speed), "generalised": numbers(J.T @ wrench)}
            if follow:
                free = [n for n in names if n not in follow]
                G = np.zeros((model.nv, first + len(free)))
                G[:first, :first] = np.eye(first)
                for i, n in enumerate(names):
                    m = follow.get(n)
                    G[first + i, first + free.index(m["of"] if m else n)] = m["multiplier"] if m else 1
                R = G.T @ M @ G
                state["reduced"] = {"names": free, "mass_matrix": numbers(R[np.triu_indices(len(R))]), "bias": numbers(G.T @ h)}
        states.append(state)
    return {"name": name, "urdf": file, "floating": floating, "root": c["root"][0], "links": c["links"], "joints": c["kinds"], "mass": number(c["mass"]),
            "mimic": [{k: v for k, v in m.items() if k != "fixed"} for m in follow.values()], "names": names, "effort": numbers([model.effortLimit[first + i] if np.isfinite(model.effortLimit[first + i]) else 0 for i in range(len(names))]),
            "states": states}


# -- Motion ------------------------------------------------------------------------------------------------------------------------

def rk4(f, t, y, dt):
    a = f(t, y)
    b = f(t + dt / 2, y + dt / 2 * a)
    c = f(t + dt / 2, y + dt / 2 * b)
    d = f(t + dt, y + dt * c)
    return y + dt / 6 * (a + 2 * b + 2 * c + d)


def double_pendulum(dt):
    """Two rods let go from rest; by Lagrange's equations written out, whose start is held against pinocchio's aba."""
    l, m, I, c = (1.0, 0.6), (1.0, 0.5), (0.083433333333333333, 0.01505), (0.5, 0.3)
    A, B, C = I[0] + m[0] * c[0] ** 2 + m[1] * l[0] ** 2, I[1] + m[1] * c[1] ** 2, m[1] * l[0] * c[1]
    g1, g2 = GRAVITY * (m[0] * c[0] + m[1] * l[0]), GRAVITY * m[1] * c[1]

    def f(_, y):
        # a and b are the angles of the rods from straight down; the elbow's is b - a.
        a, b, u, v = y
        s, k = math.sin(a - b), math.cos(a - b)
        r1, r2 = -C * s * v * v - g1 * math.sin(a), C * s * u * u - g2 * math.sin(b)
        det = A * B - (C * k) ** 2
        return np.array([u, v, (B * r1 - C * k * r2) / det, (A * r2 - C * k * r1) / det])

    def energy(y):
        a, b, u, v = y
        return 0.5 * A * u * u + 0.5 * B * v * v + C * math.cos(a - b) * u * v - g1 * math.cos(a) - g2 * math.cos(b)

    y = np.array([1.5, 2.0, 0.0, 0.0])
    model = pin.buildModelFromUrdf(str(HERE / "double_pendulum.urdf"))
    for z in (y, np.array([0.3, -1.1, 2.0, -3.0])):
        q = configuration(model, False, None, ["shoulder", "elbow"], [z[0], z[1] - z[0]])
        held = pin.aba(model, model.createData(), q, np.array([z[2], z[3] - z[2]]), np.zeros(2))
        a = f(0, z)
        assert np.allclose(held, [a[2], a[3] - a[2]], rtol=1e-12, atol=1e-12), (held, a)
    start, rows, worst = energy(y), [], 0.0
    per = round(0.1 / dt)
    for i in range(21):
        rows.append([number(0.1 * i), *numbers([y[0], y[1] - y[0], y[2], y[3] - y[2]])])
        worst = max(worst, abs(energy(y) - start))
        if i < 20:
            for _ in range(per):
                y = rk4(f, 0, y, dt)
    return rows, {"start_energy": number(start), "energy_error": worst}


def free_quadruped(dt):
    """The quadruped afloat without gravity, its joints driven by given torques; base velocity in the base's frame, a quaternion's derivative as it is."""
    model = pin.buildModelFromUrdf(str(ROOT / "rigid-couple/models/quadruped.urdf"), pin.JointModelFreeFlyer())
    model.gravity.linear = np.zeros(3)
    data = model.createData()
    names = list(model.names)[2:]
    amplitude = np.array([0.3, 0.5, 0.2, -0.2, 0.4, 0.3, 0.25, -0.5, -0.2, -0.3, -0.4, 0.25])
    phase = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5])
    frequency = 4.0
    y = np.concatenate([[0, 0, 1], [0, 0, 0, 1], [0, 0.8, -1.6] * 4, [0.3, -0.2, 0.1, 0.5, -0.4, 1.0], np.zeros(12), [0.0]])

    def f(t, y):
        q, v = y[:19].copy(), y[19:37]
        n = np.linalg.norm(q[3:7])
        q[3:7] /= n
        torque = np.zeros(18)
        torque[6:] = amplitude * np.sin(2 * math.pi * frequency * t + phase)
        a = pin.aba(model, data, q, v, torque)
        x, yy, z, w = y[3:7]
        p, o, r = v[3:6]
        # aba leaves the places of joints in the world as they were.
        R = pin.Quaternion(q[6], *q[3:6]).matrix()
        turn = 0.5 * np.array([w * p + yy * r - z * o, w * o + z * p - x * r, w * r + x * o - yy * p, -x * p - yy * o - z * r])
        return np.concatenate([R @ v[:3], turn, v[6:], a, [torque @ v]])

    def row(t, y):
        q, v = y[:19], y[19:37]
        R = pin.Quaternion(*(q[[6, 3, 4, 5]] / np.linalg.norm(q[3:7]))).matrix()
        momentum = pin.computeCentroidalMomentum(model, data, q, v).vector
        energy = pin.computeKineticEnergy(model, data, q, v)
        return numbers([t, *q[:3], *quaternion(R), *q[7:], *(R @ v[:3]), *(R @ v[3:6]), *v[6:]]), momentum.copy(), energy - y[37]

    rows, first, worst = [], None, np.zeros(3)
    per = round(0.05 / dt)
    for i in range(11):
        r, momentum, energy = row(0.05 * i, y)
        if first is None:
            first = (momentum, energy)
        worst = np.maximum(worst, [abs(momentum[:3] - first[0][:3]).max(), abs(momentum[3:] - first[0][3:]).max(), abs(energy - first[1])])
        rows.append(r)
        if i < 10:
            for k in range(per):
                y = rk4(f, 0.05 * i + k * dt, y, dt)
    return rows, {"names": names, "amplitude": amplitude.tolist(), "phase": phase.tolist(), "frequency": frequency, "linear_momentum": numbers(first[0][:3]),
                  "angular_momentum": numbers(first[0][3:]), "start_energy": number(first[1]), "momentum_error": [float(f"{x:.2g}") for x in worst[:2]], "energy_error": float(f"{worst[2]:.2g}")}


def motion(make, dt):
    """The rows at dt, and how far they are from those at 2 dt."""
    rows, more = make(dt)
    coarse, _ = make(2 * dt)
    more["step"] = dt
    more["step_error"] = float(f"{np.abs(np.array(rows) - np.array(coarse)).max():.2g}")
    more["energy_error"] = float(f"{more['energy_error']:.2g}")
    more["rows"] = rows
    return more


def main():
    if "--table" in sys.argv:
        return table()
    random = np.random.default_rng(SEED)
    versions = {p: importlib.metadata.version(p) for p in ("pin", "libpinocchio", "example-robot-data", "numpy")}
    out = {"versions": versions, "seed": SEED, "gravity": GRAVITY, "robots": [robot(*r, random) for r in ROBOTS],
           "double_pendulum": motion(double_pendulum, 1e-5), "free_quadruped": motion(free_quadruped, 2e-5)}
    # One line for each list of numbers, so that a difference can be read.
    lines = json.dumps(out, indent=1)
    lines = re.sub(r"\[[^\[\]{}]*\]", lambda m: re.sub(r"\s+", "", m.group()), lines)
    path = HERE / "truth.json"
    path.write_text(lines + "\n")
    print(f"{versions}\n{path.name}: {path.stat().st_size / 1e3:.0f} kB")
    for r in out["robots"]:
        print(f"{r['name']:16} {r['mass']:8.3f} kg  {r['links']:3} links  {r['joints']}")
    for name in ("double_pendulum", "free_quadruped"):
        print(name, {k: out[name][k] for k in out[name] if k.endswith("error")})


if __name__ == "__main__":
    main()
