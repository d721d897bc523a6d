//! The least scene that breaks the same rule.

use super::{Judge, Outcome, Rule};
use toml::{Table, Value};

/// Where a value stands: keys, and places in lists.
type Path = Vec<Step>;

#[derive(Clone, Debug, PartialEq)]
enum Step {
    Key(String),
    Entry(usize),
}

/// Takes away of a scene, and makes plainer, what it breaks a rule without: keys, entries of lists, then values. At most so many scenes are
/// tried.
pub fn shrink(judge: &Judge, scene: &Table, rule: Rule, mut tries: usize) -> Table {
    let mut least = scene.clone();
    let mut breaks = |candidate: &Table| {
        if tries == 0 {
            return false;
        }
        tries -= 1;
        matches!(judge.judge(candidate), Outcome::Failed(failure) if failure.rule == rule)
    };
    loop {
        let before = least.clone();
        for path in paths(&least).into_iter().rev() {
            // It may have gone with another.
            let Some(value) = at(&mut least.clone(), &path).cloned() else { continue };
            let mut candidates = Vec::new();
            let mut without = least.clone();
            remove(&mut without, &path);
            candidates.push(without);
            for plainer in plainer(&value) {
                let mut candidate = least.clone();
                if let Some(value) = at(&mut candidate, &path) {
                    *value = plainer;
                }
                candidates.push(candidate);
            }
            if let Some(smaller) = candidates.into_iter().find(&mut breaks) {
                least = smaller;
            }
        }
        if least == before {
            return least;
        }
    }
}

/// Every value of a scene, outer ones before inner ones.
fn paths(scene: &Table) -> Vec<Path> {
    fn add(value: &Value, path: &mut Path, paths: &mut Vec<Path>) {
        let steps: Vec<(Step, &Value)> = match value {
            Value::Table(table) => table.iter().map(|(key, value)| (Step::Key(key.clone()), value)).collect(),
            Value::Array(items) => items.iter().enumerate().map(|(i, item)| (Step::Entry(i), item)).collect(),
            _ => return,
        };
        for (step, value) in steps {
            path.push(step);
            paths.push(path.clone());
            add(value, path, paths);
            path.pop();
        }
    }
    let mut paths = Vec::new();
    add(&Value::Table(scene.clone()), &mut Vec::new(), &mut paths);
    // Whole branches first: the caller goes from the end.
    paths.sort_by_key(|path| std::cmp::Reverse(path.len()));
    paths
}

fn at<'a>(scene: &'a mut Table, path: &[Step]) -> Option<&'a mut Value> {
    let (Step::Key(first), rest) = path.split_first()? else { return None };
    rest.iter().try_fold(scene.get_mut(first)?, |value, step| match step {
        Step::Key(key) => value.get_mut(key.as_str()),
        Step::Entry(entry) => value.get_mut(*entry),
    })
}

fn remove(scene: &mut Table, path: &[Step]) {
    let Some((last, outer)) = path.split_last() else { return };
    match (last, at(scene, outer)) {
        (Step::Key(key), None) => drop(scene.remove(key)),
        (Step::Key(key), Some(Value::Table(table))) => drop(table.remove(key)),
        // Vectors keep their length.
        (Step::Entry(entry), Some(Value::Array(items))) if !items[*entry].is_float() => drop(items.remove(*entry)),
        _ => {}
    }
}

/// Plainer values than one, the plainest first.
fn plainer(value: &Value) -> Vec<Value> {
    match value {
        Value::Float(x) if *x != 0.0 && x.is_finite() => {
            let digits = |n: usize| format!("{x:.n$e}").parse::<f64>().unwrap_or(*x);
            let all = [0.0, 1.0, x.round(), digits(0), digits(1), digits(2)];
            all.into_iter().filter(|plain| plain != x).map(Value::Float).collect()
        }
        Value::Integer(n) if *n > 1 => vec![Value::Integer(0), Value::Integer(1), Value::Integer(n / 2)],
        Value::Boolean(true) => vec![Value::Boolean(false)],
        _ => Vec::new(),
    }
}
