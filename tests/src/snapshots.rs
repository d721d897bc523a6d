//! Snapshots with something wrong in them that their checksums do not tell: what the reader must find by itself.

use crate::scenes::Noise;
use barchan::worlds::Worlds;
use barchan::{Options, Registry, Result, Scene, Simulation, snapshot};
use serde_json::Value;
use std::path::Path;

const HEAD: &str = r#"
gravity = [0, 0, -9.81]
world = { cell = 0.1, min = [0, 0, 0], max = [1.6, 1.6, 0.8], walls = { z_min = "slip" }, leaving = "delete" }
material = [{ name = "s", law = "snow", density = 400 }, { name = "e", law = "neo_hookean", density = 900 }]
"#;

/// Scenes whose snapshots hold something of everything: one level, driven and free tools, nested levels with steps of their own, unbounded
/// ground with an archive, and one of several worlds.
const SEEDS: [(&str, &str); 5] = [
    (
        "plain",
        r#"
name = "plain"
time = { end = 1, step = 1e-3 }
body = [
    { material = "s", shape = { box = { min = [0.2, 0.2, 0], max = [0.4, 0.4, 0.1] } } },
    { material = "e", shape = { box = { min = [0.6, 0.6, 0], max = [0.7, 0.7, 0.1] } } },
]
"#,
    ),
    (
        "tools",
        r#"
name = "tools"
time = { end = 1, step = 1e-3 }
body = [{ material = "s", shape = { box = { min = [0.2, 0.2, 0], max = [0.4, 0.4, 0.1] } } }]
tool = [
    { name = "driven", position = [0.3, 0.3, 0.2], shape = { sphere = { radius = 0.1 } }, motion = { velocity = { linear = [0, 0, -1] } } },
    { name = "free", position = [0.7, 0.7, 0.3], shape = { box = { half = [0.1, 0.1, 0.1] } }, motion = { free = { mass = 2 } } },
]
"#,
    ),
    (
        "levels",
        r#"
name = "levels"
time = { end = 1 }
levels = { count = 3, half = 8, subcycle = true }
body = [{ material = "s", shape = { box = { min = [0, 0, 0], max = [1.2, 0.4, 0.2] } } }]
tool = [{ name = "rod", position = [0.2, 0.2, 0.3], shape = { sphere = { radius = 0.1 } }, motion = { velocity = { linear = [20, 0, -1] } } }]
"#,
    ),
    (
        "archive",
        r#"
name = "archive"
time = { end = 1 }
levels = { count = 2, half = 8, reach = 4 }
body = [{ material = "e", settled = true, shape = { box = { min = [-16, 0, 0], max = [16, 1.6, 0.2] } } }]
tool = [{ name = "rod", position = [0.2, 0.8, 0.2], shape = { sphere = { radius = 0.1 } }, motion = { velocity = { linear = [40, 0, 0] } } }]
"#,
    ),
    (
        "world",
        r#"
name = "world"
time = { end = 1, step = 1e-3 }
body = [{ material = "s", sampling = "jitter", shape = { box = { min = [0.2, 0.2, 0], max = [0.4, 0.4, 0.1] } } }]
"#,
    ),
];

/// One thread, and little memory.
pub fn options() -> Options {
    Options { threads: 1, max_bytes: Some(64 << 20), ..Options::default() }
}

/// Writes snapshots into a folder, at the start and after some steps, and returns their names.
///
/// # Errors
/// What making or saving a simulation may give.
pub fn write_seeds(registry: &Registry, folder: &Path) -> Result<Vec<String>> {
    let mut names = Vec::new();
    for (name, text) in SEEDS {
        let wide = if name == "archive" {
            HEAD.replace("min = [0, 0, 0], max = [1.6,", "min = [-16, 0, 0], max = [16,")
        } else {
            HEAD.to_owned()
        };
        let scene = Scene::from_str(&(text.to_owned() + &wide), name, "")?;
        let mut save = |simulation: &Simulation, at: &str| {
            names.push(format!("{name}-{at}"));
            simulation.save(folder.join(format!("{name}-{at}")))
        };
        if name == "world" {
            let mut worlds = Worlds::of(registry, &scene, 3, 7, &options())?;
            worlds.step().into_iter().collect::<Result<Vec<_>>>()?;
            save(worlds.world(2), "late")?;
            continue;
        }
        let mut simulation = Simulation::new(registry, &scene, &options())?;
        save(&simulation, "start")?;
        // A rod that draws on for so long leaves ground behind.
        let until = if name == "archive" { 0.1 } else { 3e-3 };
        while simulation.time() < until {
            simulation.step()?;
        }
        save(&simulation, "late")?;
    }
    Ok(names)
}

/// The head that every snapshot has, lengths that fit into the file, and right checksums. Not those of couplings: there lies the rigid solver's
/// own state in the solver's own form, which it trusts.
pub fn mended(data: &[u8]) -> Vec<u8> {
    let mut bytes = data.to_vec();
    if bytes.len() < 12 {
        return bytes;
    }
    bytes[..8].copy_from_slice(b"BARCHAN\x1a");
    bytes[8..12].copy_from_slice(&snapshot::VERSION.to_le_bytes());
    let mut at = 12;
    while at + 16 <= bytes.len() {
        let payload = at + 16;
        let announced = u64::from_le_bytes(std::array::from_fn(|i| bytes[at + 4 + i]));
        let length = announced.min((bytes.len() - payload) as u64);
        bytes[at + 4..at + 12].copy_from_slice(&length.to_le_bytes());
        let end = payload + length as usize;
        if &bytes[at..at + 4] != b"COUP" {
            let checksum = crc32fast::hash(&bytes[payload..end]);
            bytes[at + 12..at + 16].copy_from_slice(&checksum.to_le_bytes());
        }
        at = end;
    }
    bytes
}

/// Resumes from bytes as if they were a file, and goes on for two steps if that can be done. Anything but a panic will do.
pub fn try_resume(registry: &Registry, file: &Path, bytes: &[u8]) -> Option<u64> {
    std::fs::write(file, bytes).ok()?;
    let mut simulation = Simulation::resume(registry, file, &options()).ok()?;
    let taken = (0..2).take_while(|_| simulation.step().is_ok()).count();
    let _ = simulation.ledger();
    Some(taken as u64)
}

/// Changes something in a snapshot that is not a coupling's, so that it may mean anything: numbers of the header by their names, words of the other
/// sections, and which sections there are. Returns what.
pub fn mutate(bytes: &mut Vec<u8>, noise: &mut Noise) -> String {
    let mut below = |count: usize| ((0.5 + 0.5 * noise.draw()) * count as f64) as usize;
    let mut sections = Vec::new();
    let mut at = 12;
    while at + 16 <= bytes.len() {
        let length = u64::from_le_bytes(std::array::from_fn(|i| bytes[at + 4 + i])) as usize;
        sections.push((bytes[at..at + 4].to_vec(), at, at + 16, at + 16 + length));
        at += 16 + length;
    }
    let usable: Vec<_> = sections.iter().filter(|(tag, ..)| tag != b"COUP" && tag != b"END ").collect();
    let (tag, start, first, end) = usable[below(usable.len())].clone();
    let name = String::from_utf8_lossy(&tag).into_owned();
    if tag == b"HEAD" {
        let Ok(mut head) = serde_json::from_slice::<Value>(&bytes[first..end]) else { return name };
        let count = numbers(&mut head).len();
        let wrong: [f64; 12] =
            [-1.0, 0.0, 0.5, 1.0, 3.0, 1e300, -1e300, 2147483647.0, -2147483648.0, 4294967296.0, 1.8e19, 1e-320];
        let (which, value) = (below(count), wrong[below(wrong.len())]);
        let mut said = String::new();
        if let Some(number) = numbers(&mut head).into_iter().nth(which) {
            said = format!("{name}: number {which}, {number}, becomes {value}");
            *number = if value.fract() == 0.0 && value.abs() < 1e19 { (value as i64).into() } else { value.into() };
        }
        let head = serde_json::to_vec(&head).unwrap_or_default();
        bytes.splice(first..end, head.iter().copied());
        bytes[start + 4..start + 12].copy_from_slice(&(head.len() as u64).to_le_bytes());
        return said;
    }
    match below(10) {
        0 => {
            bytes.drain(start..end);
            format!("{name} at {start} is left out")
        }
        1 => {
            let copy = bytes[start..end].to_vec();
            bytes.splice(end..end, copy);
            format!("{name} at {start} comes twice")
        }
        _ => {
            // The first words say what the rest is.
            let reach = if below(2) == 0 { (end - first).min(64) } else { end - first };
            let words: [&[u8]; 8] = [
                &[0xff; 4],
                &[0xff; 8],
                &[0; 8],
                &[0, 0, 0, 0x80],
                &[0xff, 0xff, 0xff, 0x7f],
                &[1, 0, 0, 0],
                &[0, 0, 0, 0, 0, 0, 0xf8, 0x7f],
                &[0, 0, 0, 0, 0, 0, 0, 0x40],
            ];
            let place = first + below(reach.max(1));
            if below(3) == 0 {
                if let Some(byte) = bytes.get_mut(place) {
                    *byte ^= 1 << below(8);
                }
                return format!("{name} at {start}: a bit of byte {}", place - first);
            }
            let word = words[below(words.len())];
            let fits = word.len().min(end - place);
            bytes[place..place + fits].copy_from_slice(&word[..fits]);
            format!("{name} at {start}: byte {} becomes {word:?}", place - first)
        }
    }
}

/// All numbers of a JSON value.
fn numbers(value: &mut Value) -> Vec<&mut Value> {
    match value {
        Value::Number(_) => vec![value],
        Value::Array(items) => items.iter_mut().flat_map(numbers).collect(),
        Value::Object(map) => map.values_mut().flat_map(numbers).collect(),
        _ => Vec::new(),
    }
}
