//! Where a scene wants a robot's joints to go.

use super::joints::Order;
use super::model::Drive;
use crate::Refusal;
use barchan_core::scene::{JointFrame, JointMotion};
use std::collections::BTreeMap;
use std::path::Path;

/// Joint positions over time, straight from frame to frame.
#[derive(Clone, Debug)]
pub struct JointPath {
    times: Vec<f64>,
    /// For each time, positions of all drives [rad or m].
    frames: Vec<Vec<f64>>,
    repeat_from: Option<f64>,
}

/// Does a name fit a pattern in which `*` stands for any letters?
pub fn fits(pattern: &str, name: &str) -> bool {
    match pattern.split_once('*') {
        None => pattern == name,
        Some((start, rest)) => name
            .strip_prefix(start)
            .is_some_and(|behind| (0..=behind.len()).any(|i| behind.is_char_boundary(i) && fits(rest, &behind[i..]))),
    }
}

/// Sets the positions that `given` names.
///
/// # Errors
/// If a name fits no joint, or a position is not within its limits.
pub fn set(given: &BTreeMap<String, f64>, drives: &[Drive], positions: &mut [f64]) -> Result<(), Refusal> {
    // Whole names count before patterns, whatever their order.
    let (patterns, names): (Vec<_>, Vec<_>) = given.iter().partition(|(name, _)| name.contains('*'));
    for (pattern, &value) in patterns.into_iter().chain(names) {
        let mut any = false;
        for (drive, position) in drives.iter().zip(&mut *positions).filter(|(drive, _)| fits(pattern, &drive.name)) {
            any = true;
            if !(drive.limits[0]..=drive.limits[1]).contains(&value) {
                let [low, high] = drive.limits;
                return Err(Refusal::new(
                    format!("{value} is beyond the limits of joint '{}'", drive.name),
                    format!("give a position from {low} to {high}"),
                ));
            }
            *position = value;
        }
        if !any {
            let known: Vec<&str> = drives.iter().map(|drive| drive.name.as_str()).collect();
            let what = format!("no joint that moves fits '{pattern}'");
            return Err(Refusal::new(what, format!("known are: {}", known.join(", "))));
        }
    }
    Ok(())
}

impl JointPath {
    /// Of a scene's motion; `start` is where joints are before. A file is looked for in `folder`.
    ///
    /// # Errors
    /// If the file cannot be read, a joint is unknown, a position is beyond its limits, or times do not rise.
    pub fn new(motion: Option<&JointMotion>, drives: &[Drive], start: &[f64], folder: &Path) -> Result<Self, Refusal> {
        let Some(motion) = motion else {
            return Ok(Self { times: vec![0.0], frames: vec![start.to_vec()], repeat_from: None });
        };
        let read;
        let given = match &motion.file {
            Some(file) => {
                read = read_frames(&folder.join(file))?;
                &read
            }
            None => &motion.frames,
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

    /// Positions at a time, and their rates.
    fn at(&self, time: f64) -> Vec<(f64, f64)> {
        let end = self.times.last().copied().unwrap_or_default();
        let time = match self.repeat_from {
            Some(from) if time >= end => from + (time - from).rem_euclid(end - from),
            _ => time,
        };
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

    /// What motors are told in a step from `time` that takes `dt` [s].
    pub fn orders(&self, time: f64, dt: f64) -> Vec<Order> {
        let order = |(target, rate): (f64, f64)| Order { target, rate, torque: 0.0, holds: true };
        self.at(time + dt).into_iter().map(order).collect()
    }
}

fn read_frames(file: &Path) -> Result<Vec<JointFrame>, Refusal> {
    let mend = "give a CSV file: a header of 'time' and joints' names, then a row of numbers for each frame";
    let wrong = |line: usize, what: String| Refusal::new(format!("{}:{line}: {what}", file.display()), mend);
    let text = std::fs::read_to_string(file).map_err(|e| Refusal::new(format!("{}: {e}", file.display()), mend))?;
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
