//! Where a scene wants a robot's joints to go.

use super::dynamics::places;
use super::joints::Order;
use super::model::{Drive, RobotModel, by_name};
use super::reach::{Target, reach};
use crate::Refusal;
use crate::motion::{Pose, rotation_from};
use barchan_core::scene::{Gait, JointFrame, JointMotion, LinkPath};
use glam::{DQuat, DVec3};
use std::collections::BTreeMap;
use std::path::Path;

/// Motions that come with the program: name and frames.
const BUILT_IN: [(&str, &str); 2] = [
    ("quadruped-trot", include_str!("../../models/quadruped-trot.csv")),
    ("humanoid-step", include_str!("../../models/humanoid-step.csv")),
];

/// What a file of frames is.
const FRAMES: &str = "give a CSV file: a header of 'time' and joints' names, then a row of numbers for each frame";

/// Joint positions over time, straight from frame to frame.
#[derive(Clone, Debug)]
pub struct JointPath {
    times: Vec<f64>,
    /// For each time, positions of all drives [rad or m].
    frames: Vec<Vec<f64>>,
    repeat_from: Option<f64>,
}

/// Sets the positions that `given` names.
///
/// # Errors
/// If a name fits no joint, or a position is not within its limits.
pub fn set(given: &BTreeMap<String, f64>, drives: &[Drive], positions: &mut [f64]) -> Result<(), Refusal> {
    let names: Vec<&str> = drives.iter().map(|drive| drive.name.as_str()).collect();
    let found = by_name(given, &names, ["joint", "joint that moves"])?;
    for ((drive, position), given) in drives.iter().zip(positions).zip(found) {
        if let Some(given) = given {
            drive.check_position(given, 0.0)?;
            *position = given;
        }
    }
    Ok(())
}

impl JointPath {
    /// Of a scene's motion; `start` is where joints are before. A file is looked for in `folder`.
    ///
    /// # Errors
    /// If the file cannot be read, a joint is unknown, a position is beyond its limits, or times do not rise.
    pub fn new(
        motion: Option<&JointMotion>,
        model: &RobotModel,
        base: &Pose,
        start: &[f64],
        folder: &Path,
    ) -> Result<Self, Refusal> {
        let drives = &model.drives;
        let Some(motion) = motion else {
            return Ok(Self { times: vec![0.0], frames: vec![start.to_vec()], repeat_from: None });
        };
        if let Some(gait) = &motion.gait {
            return Self::of_gait(gait, model, start);
        }
        if let Some(path) = &motion.path {
            return Self::of_path(path, model, base, start);
        }
        let read;
        let given = match (&motion.file, &motion.model) {
            (Some(file), _) => {
                let file = folder.join(file);
                let text = std::fs::read_to_string(&file)
                    .map_err(|e| Refusal::new(format!("{}: {e}", file.display()), FRAMES))?;
                read = read_frames(&text, &file.display().to_string())?;
                &read
            }
            (None, Some(name)) => {
                read = read_frames(built_in(name)?, &format!("{name}.csv"))?;
                &read
            }
            (None, None) => &motion.frames,
        };
        let (mut times, mut frames) = (Vec::new(), Vec::new());
        let mut now = start.to_vec();
        for JointFrame { time, joints } in given {
            if times.last().is_some_and(|last| time <= last) {
                return Err(Refusal::new(
                    format!("a frame is at {time} s, behind one that is not before it"),
                    "times must rise",
                ));
            }
            set(joints, drives, &mut now)
                .map_err(|refusal| Refusal { what: format!("at {time} s: {}", refusal.what), ..refusal })?;
            times.push(*time);
            frames.push(now.clone());
        }
        let Some((&first, &last)) = times.first().zip(times.last()) else {
            return Err(Refusal::new("the motion has no frames", "give at least one"));
        };
        if let Some(from) = motion.repeat_from
            && !(first..last).contains(&from)
        {
            let mend = format!("give a time from {first} to before {last} s, where its frames are");
            return Err(Refusal::new(format!("repeat_from is {from}"), mend));
        }
        Ok(Self { times, frames, repeat_from: motion.repeat_from })
    }

    /// Steps of feet, seen from the base.
    fn of_gait(gait: &Gait, model: &RobotModel, start: &[f64]) -> Result<Self, Refusal> {
        let rest = places(model, false, &Pose::IDENTITY, start);
        let mut feet = Vec::new();
        for (name, phase) in &gait.feet {
            let link = find(model, name)?;
            feet.push((link, *phase, rest[link].frame.position));
        }
        let (stride, ramp) = (DVec3::from_array(gait.stride), gait.ramp);
        let mut path = Self { times: vec![gait.start], frames: vec![start.to_vec()], repeat_from: None };
        let mut positions = start.to_vec();
        // Strides grow period by period; the one behind the ramp is repeated.
        for period in 0..=ramp {
            for sample in 1..=SAMPLES {
                let time = f64::from(period) + f64::from(sample) / f64::from(SAMPLES);
                let grown = if ramp == 0 { 1.0 } else { (time / f64::from(ramp)).min(1.0) };
                let target = |&(link, phase, at): &(usize, f64, DVec3)| {
                    let [along, up] = gait.foot(time - phase);
                    let position = at + grown * (along * stride + up * gait.lift * DVec3::Z);
                    Target { link, position, rotation: None }
                };
                let targets: Vec<Target> = feet.iter().map(target).collect();
                reach(model, &Pose::IDENTITY, &targets, &mut positions)?;
                path.times.push(gait.start + time * gait.period);
                path.frames.push(positions.clone());
            }
        }
        path.repeat_from = Some(gait.start + f64::from(ramp) * gait.period);
        Ok(path)
    }

    /// A link's path, straight from place to place and eased at each.
    fn of_path(path: &LinkPath, model: &RobotModel, base: &Pose, start: &[f64]) -> Result<Self, Refusal> {
        let link = find(model, &path.link)?;
        let mut joints = Self { times: Vec::new(), frames: Vec::new(), repeat_from: None };
        let mut positions = start.to_vec();
        let turn = |rotation: &Option<[f64; 4]>| rotation.map(rotation_from).transpose();
        let mut add = |time: f64, position: DVec3, rotation: Option<DQuat>| {
            let reached = reach(model, base, &[Target { link, position, rotation }], &mut positions);
            reached.map_err(|refusal| Refusal { what: format!("at {time} s: {}", refusal.what), ..refusal })?;
            joints.times.push(time);
            joints.frames.push(positions.clone());
            Ok::<(), Refusal>(())
        };
        if let Some(first) = path.frames.first() {
            add(first.time, DVec3::from_array(first.position), turn(&first.rotation)?)?;
        }
        for pair in path.frames.windows(2) {
            let [from, to] = [&pair[0], &pair[1]];
            let [a, b] = [from, to].map(|frame| DVec3::from_array(frame.position));
            let (first, second) = (turn(&from.rotation)?, turn(&to.rotation)?);
            for sample in 1..=SAMPLES {
                let share = f64::from(sample) / f64::from(SAMPLES);
                let eased = share * share * (3.0 - 2.0 * share);
                let rotation = first.zip(second).map(|(first, second)| first.slerp(second, eased)).or(second);
                add(from.time + share * (to.time - from.time), a.lerp(b, eased), rotation)?;
            }
        }
        Ok(joints)
    }

    /// Positions at a time, and their rates.
    fn at(&self, time: f64) -> Vec<(f64, f64)> {
        let time = self.wrapped(time);
        let next = self.times.partition_point(|frame| *frame <= time);
        match (next.checked_sub(1), self.frames.get(next)) {
            (Some(last), Some(to)) => {
                let (from, span) = (&self.frames[last], self.times[next] - self.times[last]);
                let share = (time - self.times[last]) / span;
                from.iter().zip(to).map(|(a, b)| (a + share * (b - a), (b - a) / span)).collect()
            }
            (last, _) => self.frames[last.unwrap_or_default()].iter().map(|position| (*position, 0.0)).collect(),
        }
    }

    /// When its frames are [s].
    pub(crate) fn times(&self) -> &[f64] {
        &self.times
    }

    /// Positions of all drives in each frame [rad or m].
    pub(crate) fn frames(&self) -> &[Vec<f64>] {
        &self.frames
    }

    /// After how long its end repeats itself [s].
    pub(crate) fn period(&self) -> Option<f64> {
        self.repeat_from.zip(self.times.last()).map(|(from, end)| end - from)
    }

    /// The time at which it is where it is at `time`, before its end if it repeats itself.
    pub(crate) fn wrapped(&self, time: f64) -> f64 {
        let end = self.times.last().copied().unwrap_or_default();
        match self.repeat_from {
            Some(from) if time >= end => from + (time - from).rem_euclid(end - from),
            _ => time,
        }
    }

    /// Positions at its beginning.
    pub fn start(&self) -> &[f64] {
        &self.frames[0]
    }

    /// What motors are told in a step from `time` that takes `dt` [s].
    pub fn orders(&self, time: f64, dt: f64) -> Vec<Order> {
        let order = |(target, rate): (f64, f64)| Order { target, rate, torque: 0.0, holds: true };
        self.at(time + dt).into_iter().map(order).collect()
    }
}

/// Samples of a step, and between two places of a path.
const SAMPLES: u32 = 24;

/// The number of a link.
fn find(model: &RobotModel, name: &str) -> Result<usize, Refusal> {
    model.link(name).ok_or_else(|| {
        let known: Vec<&str> = model.links.iter().map(|link| link.name.as_str()).collect();
        Refusal::new(format!("there is no link '{name}'"), format!("known are: {}", known.join(", ")))
    })
}

fn built_in(name: &str) -> Result<&'static str, Refusal> {
    BUILT_IN.iter().find(|(known, _)| *known == name).map(|(_, text)| *text).ok_or_else(|| {
        let known: Vec<&str> = BUILT_IN.iter().map(|(name, _)| *name).collect();
        Refusal::new(format!("there is no motion '{name}'"), format!("known are: {}; or give a file", known.join(", ")))
    })
}

fn read_frames(text: &str, file: &str) -> Result<Vec<JointFrame>, Refusal> {
    let wrong = |line: usize, what: String| Refusal::new(format!("{file}:{line}: {what}"), FRAMES);
    // Spreadsheets put a byte order mark before it.
    let text = text.trim_start_matches('\u{feff}');
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let header: Vec<&str> = lines.next().map_or_else(Vec::new, |(_, line)| line.split(',').map(str::trim).collect());
    if header.first() != Some(&"time") {
        return Err(wrong(1, "its first column is not 'time'".to_owned()));
    }
    let row = |(i, line): (usize, &str)| {
        let numbers: Vec<f64> = line
            .split(',')
            .map(|word| word.trim().parse().ok().filter(|x: &f64| x.is_finite()))
            .collect::<Option<_>>()
            .ok_or_else(|| wrong(i + 1, "not all of it are finite numbers".to_owned()))?;
        if numbers.len() != header.len() {
            return Err(wrong(i + 1, format!("{} numbers for {} columns", numbers.len(), header.len())));
        }
        let joints = header.iter().zip(&numbers).skip(1).map(|(name, x)| ((*name).to_owned(), *x)).collect();
        Ok(JointFrame { time: numbers[0], joints })
    };
    lines.map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_of_frames_may_begin_with_a_byte_order_mark() {
        let frames = read_frames("\u{feff}time, knee\r\n0.5, -1\r\n", "walk.csv").map_err(|e| e.what).unwrap();
        assert_eq!((frames.len(), frames[0].time, frames[0].joints["knee"]), (1, 0.5, -1.0));
        let refused = read_frames("knee\n-1\n", "walk.csv").map(drop).map_err(|e| e.what);
        assert_eq!(refused, Err("walk.csv:1: its first column is not 'time'".to_owned()));
    }
}
