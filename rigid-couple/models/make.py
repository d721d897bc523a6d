#!/usr/bin/env python3
"""Writes Barchan's own robots as URDF files beside this script.

    python3 rigid-couple/models/make.py            # writes the files
    python3 rigid-couple/models/make.py --check    # fails if a file differs from what the script writes

Needs nothing but Python 3. Every number is ours: public data-sheet facts, rounded. Lengths in m, masses in kg, angles in rad; x forward, y left, z up.

A link's inertia is that of solid boxes, cylinders and spheres of the masses given here, so it is always physical.
A box is its three sides, a cylinder its radius and length along its own z, a sphere its radius.
"""
import math
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ALONG = {"x": (0, math.pi / 2, 0), "y": (math.pi / 2, 0, 0), "z": (0, 0, 0)}


def text(x):
    """A number with at most six decimals."""
    s = f"{x:.6f}".rstrip("0").rstrip(".")
    return "0" if s in ("-0", "") else s


def texts(xs):
    return " ".join(text(x) for x in xs)


def turn(rpy):
    """The attribute rpy with all digits, as six would tilt a flange by 3e-7; nothing where it is zero."""
    return f' rpy="{" ".join(f"{x:.15g}" for x in rpy)}"' if any(rpy) else ""


class Shape:
    """Box, cylinder or sphere at xyz; `rpy` turns it, a cylinder's axis may be given as a letter."""

    def __init__(self, kind, size, xyz=(0, 0, 0), rpy=(0, 0, 0), mass=0.0, colour=None):
        self.kind, self.size, self.xyz, self.mass, self.colour = kind, size, xyz, mass, colour
        self.rpy = ALONG[rpy] if isinstance(rpy, str) else rpy

    def rotation(self):
        (cr, cp, cy), (sr, sp, sy) = (map(math.cos, self.rpy)), (map(math.sin, self.rpy))
        return [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]

    def inertia(self):
        """About the shape's centre, in the link's axes."""
        m = self.mass
        if self.kind == "box":
            x, y, z = self.size
            d = [m * (y * y + z * z) / 12, m * (x * x + z * z) / 12, m * (x * x + y * y) / 12]
        elif self.kind == "cylinder":
            r, l = self.size
            d = [m * (3 * r * r + l * l) / 12] * 2 + [m * r * r / 2]
        else:
            d = [0.4 * m * self.size[0] ** 2] * 3
        R = self.rotation()
        return [[sum(R[i][k] * d[k] * R[j][k] for k in range(3)) for j in range(3)] for i in range(3)]

    def geometry(self):
        if self.kind == "box":
            return f'<box size="{texts(self.size)}"/>'
        if self.kind == "cylinder":
            return f'<cylinder radius="{text(self.size[0])}" length="{text(self.size[1])}"/>'
        return f'<sphere radius="{text(self.size[0])}"/>'

    def origin(self):
        return f'<origin xyz="{texts(self.xyz)}"{turn(self.rpy)}/>'


def box(*size, **more):
    return Shape("box", size, **more)


def cylinder(radius, length, **more):
    return Shape("cylinder", (radius, length), **more)


def sphere(radius, **more):
    return Shape("sphere", (radius,), **more)


class Robot:
    """The lines of one URDF file."""

    def __init__(self, name, comment, colours):
        self.lines = ['<?xml version="1.0"?>', "<!--", *("  " + c for c in comment), "  Written by make.py: change that.", "-->", f'<robot name="{name}">']
        for colour, rgba in colours.items():
            self.lines.append(f'  <material name="{colour}"><color rgba="{texts(rgba)}"/></material>')
        self.colours, self.mass = colours, 0.0

    def link(self, name, masses, collision, visual):
        """1. Mass and its centre. 2. Inertia about that, by Steiner. 3. Shapes that touch. 4. Shapes that are drawn."""
        m = sum(s.mass for s in masses)
        c = [sum(s.mass * s.xyz[k] for s in masses) / m for k in range(3)]
        I = [[0.0] * 3 for _ in range(3)]
        for s in masses:
            d = [s.xyz[k] - c[k] for k in range(3)]
            own, square = s.inertia(), sum(x * x for x in d)
            for i in range(3):
                for j in range(3):
                    I[i][j] += own[i][j] + s.mass * ((square if i == j else 0.0) - d[i] * d[j])
        self.mass += m
        write = self.lines.append
        write(f'  <link name="{name}">')
        write(f'    <inertial><origin xyz="{texts(c)}"/><mass value="{text(m)}"/>')
        entries = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2))
        write("      <inertia " + " ".join(f'{n}="{0.0 if abs(I[i][j]) < 1e-12 else I[i][j]:.6g}"' for n, i, j in entries) + "/></inertial>")
        for s in visual:
            write(f'    <visual>{s.origin()}<geometry>{s.geometry()}</geometry><material name="{s.colour}"/></visual>')
            assert s.colour in self.colours, s.colour
        for s in collision:
            write(f"    <collision>{s.origin()}<geometry>{s.geometry()}</geometry></collision>")
        write("  </link>")

    def joint(self, name, parent, child, xyz, axis=None, limits=None, effort=0, velocity=0, damping=0.0, friction=0.0, rpy=(0, 0, 0)):
        """Fixed where no axis is given."""
        write = self.lines.append
        kind = "revolute" if axis else "fixed"
        write(f'  <joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{texts(xyz)}"{turn(rpy)}/>' + ("" if axis else "</joint>"))
        if axis:
            lower, upper = limits
            write(f'    <axis xyz="{texts(axis)}"/><limit lower="{text(lower)}" upper="{text(upper)}" effort="{text(effort)}" velocity="{text(velocity)}"/>'
                  f'<dynamics damping="{text(damping)}" friction="{text(friction)}"/></joint>')

    def file(self):
        return "\n".join(self.lines + ["</robot>", ""])


# -- Quadruped ---------------------------------------------------------------------------------------------------------------------

def quadruped():
    """Trunk, and four legs of hip (about x), thigh and calf (about y); a foot is a ball."""
    thigh, calf, foot = 0.21, 0.21, 0.022
    r = Robot("quadruped", [
        "A four-legged robot of 15 kg with 12 joints.",
        "Facts from public data sheets: Unitree Go1 (12 kg, 0.65 x 0.28 x 0.40 m standing, joint torques 24 to 36 N m) and Go2 (15 kg with battery,",
        "0.70 x 0.31 x 0.40 m, 45 N m at most, ranges: body -48 to 48, thigh -200 to 90, shank -156 to -48 degrees). Rounded; shapes, masses by link ours.",
        "At zero angles the legs hang straight down. It stands with hip 0, thigh 0.8, calf -1.6: then the trunk's centre is 0.315 m above the ground.",
    ], {"black": (0.08, 0.08, 0.09, 1), "grey": (0.30, 0.31, 0.33, 1), "silver": (0.75, 0.76, 0.78, 1), "accent": (0.95, 0.55, 0.10, 1), "rubber": (0.13, 0.13, 0.13, 1), "lens": (0.25, 0.45, 0.70, 1)})
    r.link("trunk",
        [box(0.36, 0.16, 0.10, mass=6.2), box(0.08, 0.12, 0.08, xyz=(0.22, 0, 0.01), mass=0.5), box(0.06, 0.12, 0.08, xyz=(-0.21, 0, 0), mass=0.3)],
        [box(0.38, 0.18, 0.11), box(0.10, 0.12, 0.09, xyz=(0.23, 0, 0.01))],
        [box(0.36, 0.18, 0.08, colour="black"), box(0.32, 0.13, 0.11, colour="grey"), box(0.09, 0.12, 0.08, xyz=(0.225, 0, 0.01), colour="black"),
         box(0.008, 0.10, 0.03, xyz=(0.272, 0, 0.02), colour="lens"), box(0.05, 0.12, 0.08, xyz=(-0.205, 0, 0), colour="black"),
         box(0.20, 0.182, 0.012, xyz=(0, 0, 0.02), colour="accent"), cylinder(0.03, 0.03, xyz=(0.21, 0, 0.065), colour="silver")])
    for front, x in (("F", 1), ("R", -1)):
        for side, y in (("L", 1), ("R", -1)):
            leg = front + side
            limits = dict(damping=0.1, friction=0.2)
            r.joint(f"{leg}_hip_joint", "trunk", f"{leg}_hip", (0.19 * x, 0.05 * y, 0), (1, 0, 0), (-0.84, 0.84), 24, 30, **limits)
            r.link(f"{leg}_hip", [cylinder(0.045, 0.05, xyz=(0, 0.03 * y, 0), rpy="y", mass=0.7)],
                [cylinder(0.045, 0.04, xyz=(0, 0.03 * y, 0), rpy="y")],
                [cylinder(0.042, 0.07, rpy="x", colour="grey"), cylinder(0.045, 0.045, xyz=(0, 0.035 * y, 0), rpy="y", colour="silver")])
            r.joint(f"{leg}_thigh_joint", f"{leg}_hip", f"{leg}_thigh", (0, 0.085 * y, 0), (0, 1, 0), (-1.57, 3.49), 24, 30, **limits)
            r.link(f"{leg}_thigh", [cylinder(0.045, 0.05, xyz=(0, -0.01 * y, 0), rpy="y", mass=0.75), box(0.035, 0.025, thigh - 0.03, xyz=(0, 0, -thigh / 2), mass=0.3)],
                [box(0.04, 0.03, thigh - 0.02, xyz=(0, 0, -thigh / 2))],
                [cylinder(0.046, 0.045, xyz=(0, 0.005 * y, 0), rpy="y", colour="silver"), cylinder(0.025, 0.008, xyz=(0, 0.029 * y, 0), rpy="y", colour="accent"),
                 box(0.046, 0.030, 0.11, xyz=(0, 0, -0.065), colour="black"), box(0.034, 0.024, 0.10, xyz=(0, 0, -0.155), colour="black")])
            r.joint(f"{leg}_calf_joint", f"{leg}_thigh", f"{leg}_calf", (0, 0, -thigh), (0, 1, 0), (-2.72, -0.84), 36, 20, **limits)
            r.link(f"{leg}_calf", [cylinder(0.011, calf - 0.02, xyz=(0, 0, -calf / 2), mass=0.2)],
                [cylinder(0.012, calf - 0.03, xyz=(0, 0, -calf / 2))],
                [cylinder(0.022, 0.034, rpy="y", colour="silver"), cylinder(0.012, calf, xyz=(0, 0, -calf / 2), colour="grey")])
            r.joint(f"{leg}_foot_joint", f"{leg}_calf", f"{leg}_foot", (0, 0, -calf))
            r.link(f"{leg}_foot", [sphere(foot, mass=0.05)], [sphere(foot)], [sphere(foot, colour="rubber")])
    return r


# -- Humanoid ----------------------------------------------------------------------------------------------------------------------

def humanoid():
    """Pelvis, two legs (hip yaw, roll, pitch in one point, knee, ankle pitch and roll in one point), waist, torso with head, two arms of four joints."""
    thigh, calf, sole = 0.30, 0.30, 0.06
    r = Robot("humanoid", [
        "A humanoid of 35 kg, 1.3 m tall, with 21 joints.",
        "Facts from the public data sheet of the Unitree G1: about 35 kg with battery, 1.32 x 0.45 x 0.20 m, thigh and calf together 0.6 m,",
        "arm about 0.45 m, knee 90 to 120 N m, one waist yaw. Rounded; order of the joints, shapes and masses by link ours.",
        "Three hip axes meet in a point, the two of the ankle too. At zero angles it stands straight: the pelvis is then 0.66 m above the ground.",
    ], {"black": (0.07, 0.07, 0.08, 1), "grey": (0.28, 0.29, 0.31, 1), "silver": (0.72, 0.73, 0.76, 1), "white": (0.88, 0.89, 0.90, 1), "accent": (0.15, 0.45, 0.85, 1), "rubber": (0.12, 0.12, 0.12, 1)})
    r.link("pelvis",
        [box(0.14, 0.16, 0.10, xyz=(0, 0, 0.03), mass=4.0)],
        [box(0.14, 0.16, 0.09, xyz=(0, 0, 0.035))],
        [box(0.13, 0.15, 0.09, xyz=(0, 0, 0.035), colour="black"), cylinder(0.055, 0.06, xyz=(0, 0, 0.07), colour="silver")])
    r.joint("waist_joint", "pelvis", "torso", (0, 0, 0.09), (0, 0, 1), (-2.6, 2.6), 60, 20, damping=0.2, friction=0.2)
    r.link("torso",
        [box(0.14, 0.22, 0.30, xyz=(0, 0, 0.17), mass=8.5), box(0.05, 0.14, 0.20, xyz=(-0.08, 0, 0.18), mass=1.5)],
        [box(0.16, 0.24, 0.30, xyz=(0, 0, 0.18))],
        [box(0.12, 0.18, 0.12, xyz=(0, 0, 0.08), colour="black"), box(0.16, 0.24, 0.20, xyz=(0, 0, 0.22), colour="white"),
         box(0.012, 0.12, 0.05, xyz=(0.078, 0, 0.24), colour="accent"), box(0.05, 0.15, 0.20, xyz=(-0.09, 0, 0.20), colour="grey"),
         cylinder(0.045, 0.28, xyz=(0, 0, 0.27), rpy="y", colour="silver")])
    r.joint("head_joint", "torso", "head", (0, 0, 0.34))
    r.link("head",
        [sphere(0.075, xyz=(0, 0, 0.13), mass=1.0), cylinder(0.035, 0.08, xyz=(0, 0, 0.03), mass=0.2)],
        [sphere(0.08, xyz=(0, 0, 0.13))],
        [cylinder(0.035, 0.09, xyz=(0, 0, 0.025), colour="grey"), sphere(0.08, xyz=(0, 0, 0.13), colour="white"), sphere(0.066, xyz=(0.021, 0, 0.13), colour="black")])
    for side, y in (("left", 1), ("right", -1)):
        def mirrored(lower, upper):
            return (lower, upper) if y > 0 else (-upper, -lower)
        leg = dict(damping=0.2, friction=0.2)
        r.joint(f"{side}_hip_yaw_joint", "pelvis", f"{side}_hip_yaw", (0, 0.09 * y, 0), (0, 0, 1), mirrored(-0.8, 1.2), 60, 20, **leg)
        r.link(f"{side}_hip_yaw", [cylinder(0.045, 0.06, xyz=(0, 0.015 * y, 0.05), mass=0.8)], [],
            [cylinder(0.045, 0.05, xyz=(0, 0, 0.045), colour="silver")])
        r.joint(f"{side}_hip_roll_joint", f"{side}_hip_yaw", f"{side}_hip_roll", (0, 0, 0), (1, 0, 0), mirrored(-0.4, 1.2), 90, 20, **leg)
        r.link(f"{side}_hip_roll", [cylinder(0.045, 0.06, xyz=(-0.03, 0, 0), rpy="x", mass=0.8)], [],
            [cylinder(0.045, 0.08, xyz=(-0.02, 0, 0), rpy="x", colour="grey")])
        r.joint(f"{side}_hip_pitch_joint", f"{side}_hip_roll", f"{side}_thigh", (0, 0, 0), (0, 1, 0), (-2.4, 1.2), 90, 20, **leg)
        r.link(f"{side}_thigh", [cylinder(0.05, 0.08, rpy="y", mass=1.2), cylinder(0.045, 0.26, xyz=(0, 0, -0.16), mass=1.8)],
            [cylinder(0.05, 0.24, xyz=(0, 0, -thigh / 2))],
            [cylinder(0.052, 0.09, rpy="y", colour="silver"), cylinder(0.055, 0.16, xyz=(0, 0, -0.12), colour="white"), cylinder(0.042, 0.12, xyz=(0, 0, -0.23), colour="black")])
        r.joint(f"{side}_knee_joint", f"{side}_thigh", f"{side}_calf", (0, 0, -thigh), (0, 1, 0), (0, 2.6), 120, 20, **leg)
        r.link(f"{side}_calf", [cylinder(0.045, 0.07, rpy="y", mass=0.8), cylinder(0.035, 0.26, xyz=(0, 0, -0.15), mass=1.2)],
            [cylinder(0.04, 0.24, xyz=(0, 0, -0.14))],
            [cylinder(0.048, 0.08, rpy="y", colour="silver"), cylinder(0.042, 0.16, xyz=(0, 0, -0.12), colour="white"), cylinder(0.030, 0.12, xyz=(0, 0, -0.23), colour="black")])
        r.joint(f"{side}_ankle_pitch_joint", f"{side}_calf", f"{side}_ankle", (0, 0, -calf), (0, 1, 0), (-0.9, 0.6), 50, 20, **leg)
        r.link(f"{side}_ankle", [sphere(0.03, mass=0.2)], [], [cylinder(0.03, 0.05, rpy="y", colour="silver")])
        r.joint(f"{side}_ankle_roll_joint", f"{side}_ankle", f"{side}_foot", (0, 0, 0), (1, 0, 0), (-0.35, 0.35), 40, 20, **leg)
        r.link(f"{side}_foot", [box(0.20, 0.10, 0.03, xyz=(0.025, 0, 0.015 - sole), mass=0.6)],
            [box(0.20, 0.10, 0.03, xyz=(0.025, 0, 0.015 - sole))],
            [box(0.20, 0.10, 0.018, xyz=(0.025, 0, 0.009 - sole), colour="rubber"), box(0.18, 0.088, 0.014, xyz=(0.02, 0, 0.025 - sole), colour="black"),
             box(0.06, 0.06, 0.04, xyz=(0, 0, 0.045 - sole), colour="grey")])
        arm = dict(damping=0.1, friction=0.1)
        r.joint(f"{side}_shoulder_pitch_joint", "torso", f"{side}_shoulder", (0, 0.15 * y, 0.27), (0, 1, 0), (-3, 2.5), 25, 30, **arm)
        r.link(f"{side}_shoulder", [cylinder(0.035, 0.05, xyz=(0, 0.01 * y, 0), rpy="y", mass=0.6)], [], [cylinder(0.040, 0.05, xyz=(0, 0.01 * y, 0), rpy="y", colour="silver")])
        r.joint(f"{side}_shoulder_roll_joint", f"{side}_shoulder", f"{side}_shoulder_roll", (0, 0.04 * y, 0), (1, 0, 0), mirrored(-0.3, 2.5), 25, 30, **arm)
        r.link(f"{side}_shoulder_roll", [cylinder(0.032, 0.06, mass=0.5)], [], [sphere(0.042, colour="white")])
        r.joint(f"{side}_shoulder_yaw_joint", f"{side}_shoulder_roll", f"{side}_upper_arm", (0, 0, -0.05), (0, 0, 1), (-2.5, 2.5), 25, 30, **arm)
        r.link(f"{side}_upper_arm", [cylinder(0.03, 0.14, xyz=(0, 0, -0.07), mass=0.7)],
            [cylinder(0.035, 0.16, xyz=(0, 0, -0.07))],
            [cylinder(0.036, 0.10, xyz=(0, 0, -0.04), colour="white"), cylinder(0.028, 0.08, xyz=(0, 0, -0.11), colour="black")])
        r.joint(f"{side}_elbow_joint", f"{side}_upper_arm", f"{side}_forearm", (0, 0, -0.15), (0, 1, 0), (-2.3, 0.1), 25, 30, **arm)
        r.link(f"{side}_forearm", [cylinder(0.028, 0.16, xyz=(0, 0, -0.09), mass=0.5), sphere(0.035, xyz=(0, 0, -0.20), mass=0.2)],
            [cylinder(0.03, 0.15, xyz=(0, 0, -0.085)), sphere(0.04, xyz=(0, 0, -0.20))],
            [cylinder(0.034, 0.06, rpy="y", colour="silver"), cylinder(0.030, 0.14, xyz=(0, 0, -0.09), colour="white"), sphere(0.04, xyz=(0, 0, -0.20), colour="black")])
    return r


# -- Arm ---------------------------------------------------------------------------------------------------------------------------

def arm(tool=None):
    """Seven joints and a flange; a tool, if any, is one more link fixed to it."""
    r = Robot("arm" + (f"-{tool}" if tool else ""), [
        "An arm of seven joints" + (f" with a {tool}." if tool else ".") + " Its base stands at the origin.",
        "Facts from the public data sheet and manual of the UFACTORY xArm 7: 13.7 kg, reach 0.70 m, ranges of the joints, 180 degrees/s,",
        "distances 267, 293, 52.5, 342.5, 77.5, 76, 97 mm between the axes. Rounded; shapes, masses by link and torques ours.",
        "At zero angles the upper arm points up, the forearm down, and the flange, z out of it, down at (0.21, 0, 0.12).",
        "The flange points straight down where joint6 = joint4 - joint2 and joint3 = joint5 = 0.",
    ] + ({"rod": ["The frame of the link `rod` is the middle of its tip, z as the flange's."],
          "shovel": ["The frame of the link `shovel` is the middle of the blade's front edge, at its lower face; x to the front, where it is open, z down as the flange's."],
          "scraper": ["The frame of the link `scraper` is the middle of the plate's lower edge; z down as the flange's, the plate is square to x."]}.get(tool, [])),
        {"white": (0.90, 0.91, 0.92, 1), "grey": (0.35, 0.36, 0.38, 1), "black": (0.08, 0.08, 0.09, 1), "silver": (0.72, 0.73, 0.76, 1), "accent": (0.90, 0.35, 0.10, 1)})
    full = (-6.28, 6.28)
    r.link("base", [cylinder(0.06, 0.15, xyz=(0, 0, 0.075), mass=2.4)], [cylinder(0.063, 0.16, xyz=(0, 0, 0.08))],
        [cylinder(0.075, 0.02, xyz=(0, 0, 0.01), colour="grey"), cylinder(0.06, 0.14, xyz=(0, 0, 0.09), colour="white")])
    r.joint("joint1", "base", "link1", (0, 0, 0.27), (0, 0, 1), full, 50, 3.14, damping=1, friction=0.5)
    r.link("link1", [cylinder(0.055, 0.11, xyz=(0, 0, -0.05), mass=1.2), cylinder(0.055, 0.12, rpy="y", mass=1.2)], [cylinder(0.058, 0.16, xyz=(0, 0, -0.03))],
        [cylinder(0.060, 0.012, xyz=(0, 0, -0.105), colour="accent"), cylinder(0.057, 0.10, xyz=(0, 0, -0.05), colour="white"), cylinder(0.058, 0.13, rpy="y", colour="white"), cylinder(0.045, 0.134, rpy="y", colour="grey")])
    r.joint("joint2", "link1", "link2", (0, 0, 0), (0, 1, 0), (-2.06, 2.09), 50, 3.14, damping=1, friction=0.5)
    r.link("link2", [cylinder(0.05, 0.20, xyz=(0, 0, 0.12), mass=1.9)], [cylinder(0.055, 0.18, xyz=(0, 0, 0.13))],
        [cylinder(0.052, 0.22, xyz=(0, 0, 0.11), colour="white")])
    r.joint("joint3", "link2", "link3", (0, 0, 0.29), (0, 0, 1), full, 30, 3.14, damping=1, friction=0.5)
    r.link("link3", [cylinder(0.05, 0.07, xyz=(0, 0, -0.03), mass=0.7), cylinder(0.045, 0.10, xyz=(0.04, 0, 0), rpy="y", mass=1.0)], [cylinder(0.05, 0.11, xyz=(0.045, 0, 0), rpy="y"), cylinder(0.05, 0.08, xyz=(0, 0, -0.02))],
        [cylinder(0.053, 0.012, xyz=(0, 0, -0.065), colour="accent"), cylinder(0.05, 0.08, xyz=(0, 0, -0.02), colour="white"), cylinder(0.049, 0.11, xyz=(0.05, 0, 0), rpy="y", colour="white"), cylinder(0.038, 0.114, xyz=(0.05, 0, 0), rpy="y", colour="grey"), box(0.06, 0.08, 0.07, xyz=(0.02, 0, 0), colour="white")])
    r.joint("joint4", "link3", "link4", (0.05, 0, 0), (0, -1, 0), (-0.19, 3.92), 30, 3.14, damping=1, friction=0.5)
    r.link("link4", [cylinder(0.04, 0.15, xyz=(0.08, 0, -0.11), mass=1.3), box(0.09, 0.07, 0.06, xyz=(0.04, 0, -0.02), mass=0.5)], [cylinder(0.047, 0.15, xyz=(0.08, 0, -0.12)), box(0.09, 0.07, 0.06, xyz=(0.04, 0, -0.02))],
        [box(0.10, 0.074, 0.07, xyz=(0.045, 0, -0.015), colour="white"), cylinder(0.046, 0.20, xyz=(0.08, 0, -0.10), colour="white")])
    r.joint("joint5", "link4", "link5", (0.08, 0, -0.20), (0, 0, -1), full, 30, 3.14, damping=1, friction=0.5)
    r.link("link5", [cylinder(0.04, 0.12, xyz=(0, 0, -0.08), mass=1.0), cylinder(0.04, 0.09, xyz=(0, 0, -0.14), rpy="y", mass=0.6)], [cylinder(0.045, 0.18, xyz=(0, 0, -0.08))],
        [cylinder(0.047, 0.012, xyz=(0, 0, -0.004), colour="accent"), cylinder(0.043, 0.13, xyz=(0, 0, -0.07), colour="white"), cylinder(0.043, 0.10, xyz=(0, 0, -0.14), rpy="y", colour="white"), cylinder(0.034, 0.104, xyz=(0, 0, -0.14), rpy="y", colour="grey")])
    r.joint("joint6", "link5", "link6", (0, 0, -0.14), (0, 1, 0), (-1.69, 3.14), 20, 3.14, damping=0.5, friction=0.3)
    r.link("link6", [box(0.10, 0.06, 0.06, xyz=(0.04, 0, 0), mass=0.7), cylinder(0.038, 0.06, xyz=(0.08, 0, -0.02), mass=0.6)], [box(0.12, 0.07, 0.07, xyz=(0.045, 0, 0)), cylinder(0.038, 0.07, xyz=(0.08, 0, -0.03))],
        [box(0.11, 0.064, 0.066, xyz=(0.045, 0, 0), colour="white"), cylinder(0.039, 0.09, xyz=(0.08, 0, -0.02), colour="white")])
    r.joint("joint7", "link6", "link7", (0.08, 0, -0.07), (0, 0, -1), full, 20, 3.14, damping=0.5, friction=0.3)
    r.link("link7", [cylinder(0.037, 0.03, xyz=(0, 0, -0.015), mass=0.4)], [cylinder(0.037, 0.03, xyz=(0, 0, -0.015))],
        [cylinder(0.038, 0.02, xyz=(0, 0, -0.012), colour="silver")])
    r.joint("flange_joint", "link7", "flange", (0, 0, -0.03), rpy=(math.pi, 0, 0))
    r.link("flange", [cylinder(0.037, 0.01, xyz=(0, 0, -0.005), mass=0.1)], [cylinder(0.037, 0.01, xyz=(0, 0, -0.005))], [cylinder(0.037, 0.01, xyz=(0, 0, -0.005), colour="black")])
    if tool == "rod":
        reach = 0.15
        r.joint("rod_joint", "flange", "rod", (0, 0, reach))
        rod = dict(xyz=(0, 0, -reach / 2))
        r.link("rod", [cylinder(0.01, reach, mass=0.13, **rod)], [cylinder(0.01, reach, **rod)],
            [cylinder(0.01, reach, colour="silver", **rod), cylinder(0.02, 0.02, xyz=(0, 0, 0.01 - reach), colour="black"), cylinder(0.0102, 0.02, xyz=(0, 0, -0.0101), colour="accent")])
    elif tool == "shovel":
        # Blade of 10 x 10 cm, walls 5 cm high and 8 mm thick. The frame's z points down, so the walls stand up from z = 0 to z = -0.05.
        deep, wide, high, t, handle = 0.10, 0.10, 0.05, 0.008, 0.10
        r.joint("shovel_joint", "flange", "shovel", (deep, 0, high + handle))
        walls = [((deep, wide, t), (-deep / 2, 0, -t / 2)), ((t, wide, high), (t / 2 - deep, 0, -high / 2)),
                 ((deep, t, high), (-deep / 2, (wide - t) / 2, -high / 2)), ((deep, t, high), (-deep / 2, (t - wide) / 2, -high / 2))]
        stick = dict(xyz=(-deep, 0, -high - handle / 2 + 0.01))
        volumes = [math.prod(size) for size, _ in walls]
        masses = [box(*size, xyz=xyz, mass=0.3 * v / sum(volumes)) for (size, xyz), v in zip(walls, volumes)]
        r.link("shovel", masses + [cylinder(0.012, handle + 0.02, mass=0.1, **stick)],
            [box(*size, xyz=xyz) for size, xyz in walls] + [cylinder(0.012, handle + 0.02, **stick)],
            [box(*size, xyz=xyz, colour="silver") for size, xyz in walls] + [cylinder(0.012, handle + 0.02, colour="black", **stick)])
    elif tool == "scraper":
        # Plate 12 cm wide, 8 cm high, 1 cm thick.
        thick, wide, high, handle = 0.01, 0.12, 0.08, 0.07
        r.joint("scraper_joint", "flange", "scraper", (0, 0, high + handle))
        plate, stick = dict(xyz=(0, 0, -high / 2)), dict(xyz=(0, 0, -high - handle / 2))
        r.link("scraper", [box(thick, wide, high, mass=0.25, **plate), cylinder(0.012, handle, mass=0.08, **stick)],
            [box(thick, wide, high, **plate), cylinder(0.012, handle, **stick)],
            [box(thick, wide, high, colour="silver", **plate), cylinder(0.012, handle, colour="black", **stick)])
    return r


def main():
    robots = {"quadruped": quadruped(), "humanoid": humanoid(), "arm": arm(), "arm-rod": arm("rod"), "arm-shovel": arm("shovel"), "arm-scraper": arm("scraper")}
    differ = []
    for name, robot in robots.items():
        path = HERE / f"{name}.urdf"
        if "--check" in sys.argv:
            if not path.exists() or path.read_text() != robot.file():
                differ.append(path.name)
        else:
            path.write_text(robot.file())
            print(f"{path.name}: {robot.mass:.3f} kg")
    if differ:
        sys.exit("These differ from what make.py writes; run python3 rigid-couple/models/make.py: " + ", ".join(differ))


if __name__ == "__main__":
    main()
