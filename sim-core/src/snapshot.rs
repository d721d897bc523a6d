//! Snapshots: everything needed to continue a run bit for bit, in one file.
//!
//! ```text
//! magic (8 bytes) | version u32 | sections | section "END "
//! section: tag (4 bytes) | length u64 | CRC-32 of the payload u32 | payload
//! ```
//! All numbers are little-endian. Planes of numbers are stored as f32, and offsets as 32-bit fixed point, where that
//! loses nothing, else as f64. A plane of equal numbers is stored as one of them. Tiles of the archive are compressed by
//! deflate, and their rounded numbers take 16 bits each.

use crate::archive::Tile;
use crate::file::{Stamp, write_whole};
use crate::flow::FlowState;
use crate::simulation::{Chosen, Moment};
use crate::{
    Error, Ledger, LevelPhase, Measured, ParticleList, ParticleState, Precision, Result, SortPhase, Vec3, Wrench,
};
use miniz_oxide::deflate::compress_to_vec;
use miniz_oxide::inflate::decompress_to_vec;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

pub(crate) const MAGIC: &[u8; 8] = b"BARCHAN\x1a";
/// Version of the format that this program writes, and the only one it reads.
pub const VERSION: u32 = 7;
/// Of tiles, from 0 to 10: higher ones take twice the time and save a hundredth.
const COMPRESSION: u8 = 6;

/// More steps than any run takes.
const MOST_STEPS: u64 = 1 << 62;

const HEAD: &[u8; 4] = b"HEAD";
const LIST: &[u8; 4] = b"LIST";
const KEPT: &[u8; 4] = b"KEPT";
const SORT: &[u8; 4] = b"SORT";
const TILE: &[u8; 4] = b"TILE";
const COUPLING: &[u8; 4] = b"COUP";
const END: &[u8; 4] = b"END ";

/// What a snapshot tells about its run.
#[derive(Clone, Debug, PartialEq)]
pub struct About {
    /// The scene as it runs, as TOML.
    pub scene: String,
    /// Folder that the scene's relative paths start from.
    pub folder: PathBuf,
    /// Overrides by which the scene was [changed](crate::Scene::set) when the run began.
    pub set: Vec<String>,
    /// Number format.
    pub precision: Precision,
    /// Name of the backend that wrote it.
    pub backend: String,
    /// Simulated time [s].
    pub time: f64,
    /// Step, counted from the scene's start.
    pub step: u64,
}

/// Reads what a snapshot tells about its run, without its particles.
///
/// # Errors
/// [`Error::Snapshot`] if the file cannot be used.
pub fn about(path: impl AsRef<Path>) -> Result<About> {
    let path = path.as_ref();
    let read = || -> std::io::Result<Vec<u8>> {
        let mut file = File::open(path)?;
        let mut start = Vec::new();
        (&mut file as &mut dyn Read).take(START as u64).read_to_end(&mut start)?;
        // The header comes first. No more is read than there is.
        let length = start.last_chunk::<12>().map_or(0, |end| u64::from_le_bytes(std::array::from_fn(|i| end[i])));
        file.take(length).read_to_end(&mut start)?;
        Ok(start)
    };
    let bytes = read().map_err(|source| Error::Io { file: path.to_owned(), what: "reading a snapshot", source })?;
    let decode = || {
        let mut file = start(&bytes)?;
        match file.section()? {
            (tag, payload) if &tag == HEAD => read_head(payload),
            _ => Err(damaged("does not begin with a header".to_owned())),
        }
    };
    let head = decode().map_err(|flaw| flaw.of(path))?;
    let Head { scene, folder, set, precision, backend, time, step, .. } = head;
    Ok(About { scene, folder, set, precision, backend, time, step })
}

/// What a snapshot holds: a [state](crate::State), with its scene as text.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Snapshot {
    /// The scene as TOML.
    pub(crate) scene: String,
    /// Folder that the scene's relative paths start from.
    pub(crate) folder: PathBuf,
    /// What the scene was changed by when the run began.
    pub(crate) set: Vec<String>,
    /// The files that it reads, as they were then.
    pub(crate) files: Vec<Stamp>,
    pub(crate) moment: Moment,
}

/// The part of a snapshot that is JSON.
#[derive(Serialize, Deserialize)]
struct Head {
    scene: String,
    folder: PathBuf,
    set: Vec<String>,
    files: Vec<Stamp>,
    precision: Precision,
    backend: String,
    time: f64,
    step: u64,
    stop: Option<f64>,
    chosen: Option<Chosen>,
    cut_steps: u64,
    /// Force and torque of each.
    #[serde(default)]
    wrenches: Option<Vec<[Vec3; 2]>>,
    #[serde(default)]
    flow: FlowState,
    carried: Ledger,
    strain_dt: f64,
    levels: Option<LevelPhase>,
}

/// Writes a file under a temporary name in the same folder, then renames it.
pub(crate) fn write(
    path: &Path,
    scene: String,
    folder: PathBuf,
    set: Vec<String>,
    files: Vec<Stamp>,
    moment: &Moment,
) -> Result<()> {
    let Moment { particles, couplings, .. } = moment;
    let head = Head {
        scene,
        folder,
        set,
        files,
        precision: moment.precision,
        backend: moment.backend.clone(),
        time: moment.time,
        step: moment.step,
        stop: moment.stop,
        chosen: moment.chosen,
        cut_steps: moment.cut_steps,
        wrenches: moment.wrenches.as_ref().map(|all| all.iter().map(|w| [w.force, w.torque]).collect()),
        flow: moment.flow.clone(),
        carried: moment.carried.clone(),
        strain_dt: particles.strain_dt,
        levels: particles.levels.clone(),
    };
    write_whole(path, "writing a snapshot", |out| {
        out.write_all(MAGIC)?;
        out.write_all(&VERSION.to_le_bytes())?;
        section(out, HEAD, &serde_json::to_vec(&head)?)?;
        for list in &particles.lists {
            section(out, LIST, &encode_list(list, Order::Numbers))?;
        }
        for words in particles.kept.iter().flatten() {
            section(out, KEPT, &words.iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<_>>())?;
        }
        if let Some(sort) = &particles.sort {
            section(out, SORT, &encode_sort(sort))?;
        }
        for ([x, y], tile) in &particles.archive {
            let at = [x.to_le_bytes(), y.to_le_bytes()];
            section(out, TILE, &[at.as_flattened(), tile.packed()].concat())?;
        }
        for (name, bytes) in couplings {
            let mut payload = Vec::new();
            put_bytes(&mut payload, name.as_bytes());
            payload.extend_from_slice(bytes);
            section(out, COUPLING, &payload)?;
        }
        section(out, END, &[])
    })
}

impl Snapshot {
    /// Reads and checks a file. Nothing is allocated by a length that the file does not bear out.
    pub(crate) fn read(path: &Path) -> Result<Self> {
        let bytes = std::fs::read(path).map_err(|source| Error::Io {
            file: path.to_owned(),
            what: "reading a snapshot",
            source,
        })?;
        Self::decode(&bytes).map_err(|flaw| flaw.of(path))
    }

    /// What is wrong with the time and the steps that it says, if anything: what goes on from there must be able to count and to add.
    pub(crate) fn unsound_clock(&self) -> Option<String> {
        let Moment { time, step, stop, chosen, .. } = &self.moment;
        if !time.is_finite() || *step > MOST_STEPS {
            return Some(format!("was saved at step {step} and {time} s"));
        }
        if stop.is_some_and(|stop| stop.is_nan()) || chosen.is_some_and(|chosen| !chosen.is_sound()) {
            return Some(format!("goes on to {stop:?} s with steps as {chosen:?}"));
        }
        None
    }

    fn decode(bytes: &[u8]) -> Result<Self, Flaw> {
        let mut file = start(bytes)?;
        let mut head: Option<Head> = None;
        let mut particles = ParticleState::default();
        let mut couplings = Vec::new();
        loop {
            let (tag, payload) = file.section()?;
            let mut inner = Reader(payload);
            match &tag {
                HEAD => head = Some(read_head(payload)?),
                LIST => particles.lists.push(decode_list(&mut inner, Order::Numbers)?),
                KEPT => {
                    let words = std::mem::take(&mut inner.0).as_chunks::<4>();
                    if !words.1.is_empty() {
                        return Err(damaged("holds part of a word".to_owned()));
                    }
                    let words = words.0.iter().map(|b| u32::from_le_bytes(*b)).collect();
                    particles.kept.get_or_insert_default().push(words);
                }
                SORT => particles.sort = Some(decode_sort(&mut inner)?),
                TILE => {
                    let at = [inner.array()?, inner.array()?].map(i32::from_le_bytes);
                    particles.archive.insert(at, Tile::read(std::mem::take(&mut inner.0))?);
                }
                COUPLING => {
                    let name = String::from_utf8_lossy(inner.bytes()?).into_owned();
                    couplings.push((name, std::mem::take(&mut inner.0).to_vec()));
                }
                END => break,
                _ => return Err(damaged(format!("holds an unknown section {tag:?}"))),
            }
            if !inner.0.is_empty() && &tag != HEAD {
                return Err(damaged(format!("section {} is too long", String::from_utf8_lossy(&tag))));
            }
        }
        if !file.0.is_empty() {
            return Err(damaged(format!("has {} bytes after its end", file.0.len())));
        }
        let head = head.ok_or_else(|| damaged("has no header".to_owned()))?;
        particles.strain_dt = head.strain_dt;
        particles.levels = head.levels;
        Ok(Self {
            scene: head.scene,
            folder: head.folder,
            set: head.set,
            files: head.files,
            moment: Moment {
                precision: head.precision,
                backend: head.backend,
                time: head.time,
                step: head.step,
                stop: head.stop,
                chosen: head.chosen,
                cut_steps: head.cut_steps,
                wrenches: head
                    .wrenches
                    .map(|all| all.iter().map(|&[force, torque]| Wrench { force, torque }).collect()),
                flow: head.flow,
                carried: head.carried,
                particles,
                couplings,
            },
        })
    }
}

/// What is wrong with a file's bytes.
pub(crate) struct Flaw {
    what: String,
    mend: &'static str,
}

impl Flaw {
    /// The error it becomes for a file.
    fn of(self, file: &Path) -> Error {
        Error::Snapshot { file: file.to_owned(), what: self.what, mend: self.mend.to_owned() }
    }
}

/// Bytes of what comes before the header's payload.
const START: usize = MAGIC.len() + 4 + 16;

/// What follows on magic and version.
fn start(bytes: &[u8]) -> Result<Reader<'_>, Flaw> {
    let mut file = Reader(bytes);
    if file.take(MAGIC.len()).ok() != Some(MAGIC) {
        return Err(Flaw { what: "is no snapshot".to_owned(), mend: "give a file that `save` has written" });
    }
    let version = u32::from_le_bytes(file.array()?);
    if version != VERSION {
        return Err(Flaw {
            what: format!("has format version {version}, this program reads {VERSION}"),
            mend: "resume with the version of the program that wrote it",
        });
    }
    Ok(file)
}

fn read_head(payload: &[u8]) -> Result<Head, Flaw> {
    serde_json::from_slice(payload).map_err(|e| damaged(format!("header: {e}")))
}

fn damaged(what: String) -> Flaw {
    Flaw { what, mend: "the file is damaged: resume from an earlier snapshot" }
}

fn section(out: &mut impl Write, tag: &[u8; 4], payload: &[u8]) -> std::io::Result<()> {
    out.write_all(tag)?;
    out.write_all(&(payload.len() as u64).to_le_bytes())?;
    out.write_all(&crc32fast::hash(payload).to_le_bytes())?;
    out.write_all(payload)
}

/// Bytes not yet read.
struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn take(&mut self, count: usize) -> Result<&'a [u8], Flaw> {
        let (taken, rest) = self
            .0
            .split_at_checked(count)
            .ok_or_else(|| damaged(format!("is cut short: {count} bytes should follow and {} do", self.0.len())))?;
        self.0 = rest;
        Ok(taken)
    }
    fn array<const N: usize>(&mut self) -> Result<[u8; N], Flaw> {
        self.take(N).map(|bytes| std::array::from_fn(|i| bytes[i]))
    }
    fn u32(&mut self) -> Result<u32, Flaw> {
        self.array().map(u32::from_le_bytes)
    }
    fn u64(&mut self) -> Result<u64, Flaw> {
        self.array().map(u64::from_le_bytes)
    }
    fn f64(&mut self) -> Result<f64, Flaw> {
        self.array().map(f64::from_le_bytes)
    }
    fn bytes(&mut self) -> Result<&'a [u8], Flaw> {
        let length = self.length(1)?;
        self.take(length)
    }
    /// A count of entries of `size` bytes each, which must fit into what is left.
    fn length(&mut self, size: usize) -> Result<usize, Flaw> {
        let count = self.u64()?;
        usize::try_from(count)
            .ok()
            .filter(|n| n.checked_mul(size).is_some_and(|bytes| bytes <= self.0.len()))
            .ok_or_else(|| {
                damaged(format!("announces {count} entries of {size} bytes with {} bytes left", self.0.len()))
            })
    }
    fn section(&mut self) -> Result<([u8; 4], &'a [u8]), Flaw> {
        let tag = self.array()?;
        let name = String::from_utf8_lossy(&tag).into_owned();
        let length = self.u64()?;
        let checksum = self.u32()?;
        let length = usize::try_from(length).ok().filter(|n| *n <= self.0.len()).ok_or_else(|| {
            damaged(format!("is cut short: section {name} should have {length} bytes and {} follow", self.0.len()))
        })?;
        let payload = self.take(length)?;
        if crc32fast::hash(payload) != checksum {
            return Err(damaged(format!("section {name} has a wrong checksum")));
        }
        Ok((tag, payload))
    }
    /// `count` numbers as [`put_plane`] wrote them.
    fn plane(&mut self, count: usize, order: Order) -> Result<Vec<f64>, Flaw> {
        let [form] = self.array()?;
        Ok(match form {
            FORM_SAME => {
                // The count is borne out by the ids, and there are not many planes.
                let value = self.f64()?;
                vec![value; count]
            }
            FORM_STEPS => {
                let (base, step) = (self.f64()?, self.f64()?);
                let signed = |k: u16| f64::from((k >> 1) as i16 ^ -((k & 1) as i16));
                order.take(self.take(2 * count)?).map(u16::from_le_bytes).map(|k| base + signed(k) * step).collect()
            }
            FORM_F32 => order.take(self.take(4 * count)?).map(|b| f64::from(f32::from_le_bytes(b))).collect(),
            FORM_FIXED => order.take(self.take(4 * count)?).map(|b| f64::from(u32::from_le_bytes(b)) / FIXED).collect(),
            FORM_F64 => order.take(self.take(8 * count)?).map(f64::from_le_bytes).collect(),
            other => return Err(damaged(format!("holds numbers in unknown form {other}"))),
        })
    }
    fn rows<const N: usize>(&mut self, count: usize, order: Order) -> Result<Vec<[f64; N]>, Flaw> {
        Ok(self.plane(N * count, order)?.as_chunks().0.to_vec())
    }
}

const FORM_F32: u8 = 0;
const FORM_F64: u8 = 1;
const FORM_FIXED: u8 = 2;
const FORM_SAME: u8 = 3;
const FORM_STEPS: u8 = 4;
/// More strain or history planes than any law has.
const MOST_PLANES: u32 = 256;
/// Counts of a fixed-point offset in one cell.
const FIXED: f64 = (1_u64 << 32) as f64;

/// How numbers lie in a list's bytes.
#[derive(Clone, Copy)]
pub(crate) enum Order {
    /// One after the other.
    Numbers,
    /// All first bytes, all second bytes, and so on, which compresses better.
    Bytes,
}

impl Order {
    fn put<const N: usize>(self, out: &mut Vec<u8>, numbers: impl Iterator<Item = [u8; N]> + Clone) {
        match self {
            Self::Numbers => numbers.for_each(|bytes| out.extend_from_slice(&bytes)),
            Self::Bytes => (0..N).for_each(|k| out.extend(numbers.clone().map(|bytes| bytes[k]))),
        }
    }

    /// What `put` has put there.
    fn take<const N: usize>(self, bytes: &[u8]) -> impl Iterator<Item = [u8; N]> {
        let count = bytes.len() / N;
        (0..count).map(move |i| {
            std::array::from_fn(|k| match self {
                Self::Numbers => bytes[N * i + k],
                Self::Bytes => bytes[count * k + i],
            })
        })
    }
}

/// Numbers in the least form that loses nothing.
fn put_plane(out: &mut Vec<u8>, order: Order, values: &[f64]) {
    let as_f32 = |x: &f64| f64::from(*x as f32).to_bits() == x.to_bits();
    // The f32 form keeps the sign of zero; the fixed form is for offsets, which are never negative.
    let as_fixed = |x: &f64| (0.0..1.0).contains(x) && x.is_sign_positive() && (x * FIXED).fract() == 0.0;
    if values.len() > 2 && values.iter().all(|x| x.to_bits() == values[0].to_bits()) {
        out.push(FORM_SAME);
        out.extend_from_slice(&values[0].to_le_bytes());
    } else if let Some((base, step, counts)) = matches!(order, Order::Bytes).then(|| whole_steps(values)).flatten() {
        out.push(FORM_STEPS);
        [base, step].iter().for_each(|x| out.extend_from_slice(&x.to_le_bytes()));
        // Signs last, so that small numbers have small bytes.
        order.put(out, counts.iter().map(|k| ((k << 1) ^ (k >> 15)).to_le_bytes()));
    } else if values.iter().all(as_fixed) {
        out.push(FORM_FIXED);
        order.put(out, values.iter().map(|x| ((x * FIXED) as u32).to_le_bytes()));
    } else if values.iter().all(as_f32) {
        out.push(FORM_F32);
        order.put(out, values.iter().map(|x| (*x as f32).to_le_bytes()));
    } else {
        out.push(FORM_F64);
        order.put(out, values.iter().map(|x| x.to_le_bytes()));
    }
}

/// A whole number, a power of two, and how many of these each value is away from it, if all are so: rounded numbers are.
fn whole_steps(values: &[f64]) -> Option<(f64, f64, Vec<i16>)> {
    let base = values.first()?.round();
    let mut last_place = i32::MAX - 1023;
    for off in values.iter().map(|x| x - base).filter(|off| *off != 0.0) {
        if !off.is_normal() {
            return None;
        }
        let exponent = (off.to_bits() >> 52 & 0x7ff) as i32 - 1023;
        last_place = last_place.min(exponent - 52 + (off.to_bits() | 1 << 52).trailing_zeros() as i32);
        if exponent - last_place > 14 {
            return None;
        }
    }
    let step = f64::from_bits(u64::try_from(last_place + 1023).ok().filter(|bits| (1..2047).contains(bits))? << 52);
    let counts: Vec<i16> = values.iter().map(|x| ((x - base) / step) as i16).collect();
    let same = |(k, x): (&i16, &f64)| (base + f64::from(*k) * step).to_bits() == x.to_bits();
    counts.iter().zip(values).all(same).then_some((base, step, counts))
}

fn put_bytes(out: &mut Vec<u8>, bytes: &[u8]) {
    out.extend_from_slice(&(bytes.len() as u64).to_le_bytes());
    out.extend_from_slice(bytes);
}

pub(crate) fn encode_list(list: &ParticleList, order: Order) -> Vec<u8> {
    let mut out = Vec::new();
    for number in [list.world, list.level, list.material, list.strain.len() as u32, list.state.len() as u32] {
        out.extend_from_slice(&number.to_le_bytes());
    }
    out.extend_from_slice(&list.cell_width.to_le_bytes());
    out.extend_from_slice(&(list.len() as u64).to_le_bytes());
    match order {
        Order::Numbers => order.put(&mut out, list.id.iter().map(|id| id.to_le_bytes())),
        // By how much each is more than the one before.
        Order::Bytes => {
            let before = std::iter::once(0).chain(list.id.iter().copied());
            order.put(&mut out, before.zip(&list.id).map(|(last, id)| id.wrapping_sub(last).to_le_bytes()));
        }
    }
    order.put(&mut out, list.body.iter().map(|body| body.to_le_bytes()));
    order.put(&mut out, list.cell.as_flattened().iter().map(|c| c.to_le_bytes()));
    for rows in [list.offset.as_flattened(), list.velocity.as_flattened(), list.affine.as_flattened()] {
        put_plane(&mut out, order, rows);
    }
    for plane in [&list.mass, &list.volume0].into_iter().chain(&list.strain).chain(&list.state) {
        put_plane(&mut out, order, plane);
    }
    out
}

fn decode_list(from: &mut Reader<'_>, order: Order) -> Result<ParticleList, Flaw> {
    let [world, level, material, strain, state] = [from.u32()?, from.u32()?, from.u32()?, from.u32()?, from.u32()?];
    if strain > MOST_PLANES || state > MOST_PLANES {
        return Err(damaged(format!("announces {strain} strain and {state} history planes")));
    }
    let cell_width = from.f64()?;
    // Id, body and cell take 22 bytes a particle, so the count is borne out by the file from here on.
    let n = from.length(8 + 2 + 12)?;
    let mut ids: Vec<u64> = order.take(from.take(8 * n)?).map(u64::from_le_bytes).collect();
    if let Order::Bytes = order {
        (1..n).for_each(|i| ids[i] = ids[i].wrapping_add(ids[i - 1]));
    }
    let body = order.take(from.take(2 * n)?).map(u16::from_le_bytes).collect();
    let cells: Vec<i32> = order.take(from.take(12 * n)?).map(i32::from_le_bytes).collect();
    Ok(ParticleList {
        world,
        level,
        material,
        cell_width,
        id: ids,
        body,
        cell: cells.as_chunks().0.to_vec(),
        offset: from.rows(n, order)?,
        velocity: from.rows(n, order)?,
        affine: from.rows(n, order)?,
        mass: from.plane(n, order)?,
        volume0: from.plane(n, order)?,
        strain: (0..strain).map(|_| from.plane(n, order)).collect::<Result<_, _>>()?,
        state: (0..state).map(|_| from.plane(n, order)).collect::<Result<_, _>>()?,
    })
}

/// Lists that stand one after another, compressed.
pub(crate) fn encode_tile(lists: &[ParticleList]) -> Vec<u8> {
    let bytes: Vec<u8> = lists.iter().flat_map(|list| encode_list(list, Order::Bytes)).collect();
    compress_to_vec(&bytes, COMPRESSION)
}

pub(crate) fn decode_tile(bytes: &[u8]) -> Result<Vec<ParticleList>, Flaw> {
    let bytes = decompress_to_vec(bytes).map_err(|e| damaged(format!("holds a tile that cannot be unpacked: {e}")))?;
    let (mut from, mut lists) = (Reader(&bytes), Vec::new());
    while !from.0.is_empty() {
        lists.push(decode_list(&mut from, Order::Bytes)?);
    }
    Ok(lists)
}

fn encode_sort(sort: &SortPhase) -> Vec<u8> {
    let mut out = Vec::new();
    out.extend_from_slice(&sort.age.to_le_bytes());
    out.extend_from_slice(&(sort.drift.len() as u64).to_le_bytes());
    sort.drift.iter().for_each(|drift| out.extend_from_slice(&drift.to_le_bytes()));
    out.extend_from_slice(&sort.measured.stiffness_bound.to_le_bytes());
    out.extend_from_slice(&sort.measured.stiffness_age.to_le_bytes());
    [sort.measured.mass, sort.measured.least_mass].iter().for_each(|mass| out.extend_from_slice(&mass.to_le_bytes()));
    out.extend_from_slice(&(sort.blocks.len() as u64).to_le_bytes());
    for (key, counts) in &sort.blocks {
        key.iter().for_each(|k| out.extend_from_slice(&k.to_le_bytes()));
        out.extend_from_slice(&(counts.len() as u64).to_le_bytes());
        counts.iter().for_each(|c| out.extend_from_slice(&c.to_le_bytes()));
    }
    sort.rest.iter().for_each(|rest| out.extend_from_slice(&rest.to_le_bytes()));
    for kept_for in &sort.kept_for {
        // No step has no length.
        let (dt, gravity) = kept_for.unwrap_or_default();
        std::iter::once(dt).chain(gravity).for_each(|x| out.extend_from_slice(&x.to_le_bytes()));
    }
    out
}

fn decode_sort(from: &mut Reader<'_>) -> Result<SortPhase, Flaw> {
    let age = from.u32()?;
    let levels = from.length(8)?;
    let drift = (0..levels).map(|_| from.f64()).collect::<Result<_, _>>()?;
    let measured = Measured {
        stiffness_bound: from.f64()?,
        stiffness_age: from.u32()?,
        mass: from.f64()?,
        least_mass: from.f64()?,
    };
    // A block takes 20 bytes of key and 8 of count at least.
    let count = from.length(20 + 8)?;
    let blocks = (0..count)
        .map(|_| {
            let mut key = [0; 5];
            for k in &mut key {
                *k = i32::from_le_bytes(from.array()?);
            }
            let lists = from.length(4)?;
            let counts = from.take(4 * lists)?.as_chunks::<4>().0.iter().map(|b| u32::from_le_bytes(*b)).collect();
            Ok((key, counts))
        })
        .collect::<Result<Vec<_>, _>>()?;
    let rest = (0..blocks.len()).map(|_| from.array().map(u16::from_le_bytes)).collect::<Result<_, _>>()?;
    let kept_for = (0..levels)
        .map(|_| {
            let (dt, gravity) = (from.f64()?, [from.f64()?, from.f64()?, from.f64()?]);
            Ok((dt > 0.0).then_some((dt, gravity)))
        })
        .collect::<Result<_, _>>()?;
    Ok(SortPhase { age, drift, measured, blocks, rest, kept_for })
}
