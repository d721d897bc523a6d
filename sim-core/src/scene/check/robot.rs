//! What a robot's entry must hold, before its URDF is read.

use crate::Result;
use crate::scene::{Contact, Robot, Scene};

/// Points of a scan at most.
const MOST_POINTS: u64 = 1_000_000;

impl Scene {
    pub(super) fn check_robot(&self, path: &str, robot: &Robot) -> Result<()> {
        let name = format!("{path}.name");
        self.require(
            !robot.name.contains('/'),
            &name,
            format!("is '{}'", robot.name),
            "leave out slashes: links are called robot/link",
        )?;
        let taken = self.tool.iter().any(|tool| tool.name == robot.name);
        self.require(!taken, &name, format!("'{}' is a tool's name, too", robot.name), "rename one of them")?;
        let one = robot.urdf.is_some() != robot.model.is_some();
        self.require(one, path, "needs a URDF file or a built-in model", "give either urdf or model")?;
        self.check_rotation(&format!("{path}.rotation"), &robot.rotation)?;
        if let Contact::Coulomb { friction } = robot.contact {
            self.not_negative(&format!("{path}.contact.coulomb.friction"), friction)?;
        }
        for (i, motor) in robot.motor.iter().enumerate() {
            for (key, value) in
                [("kp", motor.kp), ("kd", motor.kd), ("effort", motor.effort), ("armature", motor.armature)]
            {
                self.not_negative(&format!("{path}.motor[{i}].{key}"), value.unwrap_or(0.0))?;
            }
        }
        for i in 0..robot.balance.len() {
            let path = format!("{path}.balance[{i}]");
            self.require(!robot.fixed, &path, "needs a base that moves", "leave it out, or leave out fixed = true")?;
        }
        if let Some(scan) = &robot.scan {
            let path = format!("{path}.scan");
            for d in 0..2 {
                let [min, max] = [scan.min[d], scan.max[d]];
                let what = format!("{} goes from {min} to {max}", ["x", "y"][d]);
                self.require(min <= max, &format!("{path}.max"), what, "must be min or above")?;
            }
            let [nx, ny] = scan.points.map(u64::from);
            let what = format!("asks for {nx} by {ny} points");
            let mend = format!("give at least one along x and y, and at most {MOST_POINTS} in all");
            self.require((1..=MOST_POINTS).contains(&(nx * ny)), &format!("{path}.points"), what, mend)?;
        }
        let Some(motion) = &robot.motion else { return Ok(()) };
        let frames = format!("{path}.motion.frames");
        let given = [
            motion.file.is_some(),
            motion.model.is_some(),
            !motion.frames.is_empty(),
            motion.gait.is_some(),
            motion.path.is_some(),
        ];
        let one = given.into_iter().filter(|given| *given).count() == 1;
        self.require(
            one,
            &format!("{path}.motion"),
            "has to say one way",
            "give one of frames, file, model, gait and path",
        )?;
        if let Some(gait) = &motion.gait {
            let path = format!("{path}.motion.gait");
            self.positive(&format!("{path}.period"), gait.period)?;
            self.not_negative(&format!("{path}.lift"), gait.lift)?;
            let share = gait.stance > 0.0 && gait.stance < 1.0;
            self.require(share, &format!("{path}.stance"), format!("is {}", gait.stance), "must be between 0 and 1")?;
            self.require(!gait.feet.is_empty(), &format!("{path}.feet"), "is empty", "name the links that step")?;
        }
        if let Some(link) = &motion.path {
            let path = format!("{path}.motion.path");
            self.require(robot.fixed, &path, "needs a base that stays", "set fixed = true for the robot")?;
            self.require(!link.frames.is_empty(), &format!("{path}.frames"), "is empty", "give at least one place")?;
            for (i, pair) in link.frames.windows(2).enumerate() {
                let [before, time] = [pair[0].time, pair[1].time];
                let at = format!("{path}.frames[{}].time", i + 1);
                self.rises(&at, before, time)?;
            }
        }
        for (i, pair) in motion.frames.windows(2).enumerate() {
            let [before, time] = [pair[0].time, pair[1].time];
            let at = format!("{frames}[{}].time", i + 1);
            self.rises(&at, before, time)?;
        }
        Ok(())
    }
}
