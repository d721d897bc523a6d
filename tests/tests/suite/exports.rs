//! Files for other programs, read as `docs/formats.md` says: with the archive's own format, not with the code that wrote them.

use barchan::export::{Fields, particles};
use barchan::run::{Existing, Request, Until, run};
use barchan::scene::Export;
use barchan::{Options, Precision, Scene, Simulation};
use barchan_tests::scenes::{scene, simulation};
use barchan_tests::sketch::{Head, block, material};
use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::record::Field;
use std::collections::BTreeMap;
use std::io::Read;
use std::ops::ControlFlow;
use std::path::Path;

/// Arrays of an archive: shape and values by name; the header as text.
struct Archive {
    arrays: BTreeMap<String, (Vec<usize>, Vec<f64>)>,
    header: String,
}

impl Archive {
    fn read(path: &Path) -> Self {
        let mut zip = zip::ZipArchive::new(std::fs::File::open(path).unwrap()).unwrap();
        let (mut arrays, mut header) = (BTreeMap::new(), String::new());
        for i in 0..zip.len() {
            let mut member = zip.by_index(i).unwrap();
            let name = member.name().unwrap().strip_suffix(".npy").expect("members are arrays").to_owned();
            let mut bytes = Vec::new();
            member.read_to_end(&mut bytes).unwrap();
            assert_eq!(&bytes[..8], b"\x93NUMPY\x01\0");
            let length = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
            assert_eq!(length % 64, 0, "data is not aligned");
            let about = std::str::from_utf8(&bytes[10..length]).unwrap();
            let between = |from: &str, to: &str| about.split(from).nth(1).unwrap().split(to).next().unwrap();
            let shape: Vec<usize> =
                between("'shape': (", ")").split(',').filter_map(|n| n.trim().parse().ok()).collect();
            let data = &bytes[length..];
            let values: Vec<f64> = match between("'descr': '", "'") {
                "<f8" => data.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
                "<f4" => data.as_chunks().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect(),
                "<u8" => data.as_chunks().0.iter().map(|b| u64::from_le_bytes(*b) as f64).collect(),
                "<u2" => data.as_chunks().0.iter().map(|b| f64::from(u16::from_le_bytes(*b))).collect(),
                "|u1" => data.iter().map(|b| f64::from(*b)).collect(),
                other => panic!("{other} is not a kind that the document names"),
            };
            assert_eq!(values.len(), shape.iter().product::<usize>());
            if name == "header" {
                header = String::from_utf8(data.to_vec()).unwrap();
            }
            arrays.insert(name, (shape, values));
        }
        Self { arrays, header }
    }

    fn of(&self, name: &str) -> &[f64] {
        &self.arrays.get(name).unwrap_or_else(|| panic!("{name} is not among {:?}", self.arrays.keys())).1
    }

    /// Component c of a field.
    fn component(&self, name: &str, c: usize) -> Vec<f64> {
        let (shape, values) = &self.arrays[name];
        values.iter().skip(c).step_by(shape[1]).copied().collect()
    }
}

/// Settled sand, 24 cm deep, with a block of jelly falling beside.
fn sand_and_jelly(precision: Precision) -> Simulation {
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"slip\"";
    let head = Head::cells(0.02, [12, 6, 16], walls);
    simulation(
        &head.with(&[
            material("sand", 1500.0, "young_modulus = 1e6, poisson_ratio = 0.2, friction_angle_deg = 30.0"),
            material("neo_hookean", 900.0, "young_modulus = 1e5, poisson_ratio = 0.3"),
            block("sand", [0.0; 3], [0.12, 0.12, 0.24], "settled = true"),
            block("neo_hookean", [0.16, 0.02, 0.1], [0.22, 0.1, 0.16], "velocity = [0.0, 0.1, -0.5]\nname = \"jelly\""),
        ]),
        precision,
    )
}

fn export(simulation: &Simulation, folder: &Path, format: Export, fields: Option<&[&str]>) -> std::path::PathBuf {
    let patterns: Option<Vec<String>> = fields.map(|fields| fields.iter().map(|&field| field.to_owned()).collect());
    let fields = Fields::new(simulation.plan(), patterns.as_deref()).unwrap();
    let path = folder.join(format!("particles.{}", format.extension()));
    particles(simulation, &fields, &path, format).unwrap();
    path
}

/// What is computed from a file is what the ledger says, and the stress in it bears the ground's weight: sigma_zz = -rho g (H - z), K0 = 1/3.
#[test]
fn exported_particles_bear_their_weight_and_add_up_to_the_ledger() {
    for precision in [Precision::F32, Precision::F64] {
        let folder = tempfile::tempdir().unwrap();
        let mut simulation = sand_and_jelly(precision);
        simulation.step().unwrap();
        let file = Archive::read(&export(&simulation, folder.path(), Export::Npz, None));
        let ledger = simulation.ledger();
        let n = simulation.particle_count();
        assert_eq!((file.arrays["position"].0.as_slice(), file.of("id").len()), ([n, 3].as_slice(), n));
        assert_eq!(file.of("time"), [simulation.time()]);
        let about: serde_json::Value = serde_json::from_str(&file.header).unwrap();
        assert_eq!(about["fields"]["stress"]["unit"], "Pa");
        assert_eq!((&about["materials"][1], &about["bodies"][1]), (&"neo_hookean".into(), &"jelly".into()));

        let mass = file.of("mass");
        let close =
            |a: f64, b: f64, what: &str| assert!((a - b).abs() < 1e-6 * b.abs(), "{precision}, {what}: {a}, {b}");
        close(mass.iter().sum(), ledger.mass, "mass");
        for (d, axis) in ["x", "y", "z"].iter().enumerate().skip(1) {
            let momentum: f64 = file.component("velocity", d).iter().zip(mass).map(|(v, m)| v * m).sum();
            close(momentum, ledger.momentum[d], axis);
        }

        // A lattice of two a cell: stress per layer, by where particles are.
        let [zz, xx, z] = [file.component("stress", 2), file.component("stress", 0), file.component("position", 2)];
        let sand: Vec<usize> = (0..n).filter(|&i| file.of("material")[i] == 0.0).collect();
        assert_eq!(sand.len(), 12 * 12 * 24);
        for &i in &sand {
            let weight = 1500.0 * 9.81 * (0.24 - z[i]);
            assert!((-zz[i] / weight - 1.0).abs() < 0.02, "{precision}: sigma_zz {} at {} m", zz[i], z[i]);
            assert!((xx[i] / zz[i] * 3.0 - 1.0).abs() < 0.02, "{precision}: K0 {}", xx[i] / zz[i]);
            // Pressed ground is denser.
            assert!(file.of("density")[i] > 1500.0 && file.of("density")[i] < 1510.0);
        }
        // Each law's own history, and nothing of it elsewhere; the law that keeps F shows it, and b = F F^T.
        let gap = file.of("history_sand_volume_gap");
        assert!((0..n).all(|i| gap[i].is_nan() == (file.of("material")[i] == 1.0)));
        let strain = file.arrays.get("def_grad").map(|(shape, f)| (shape, f));
        if let Some((shape, f)) = strain {
            let jelly = n - 1;
            let row: f64 = f[shape[1] * jelly..][..3].iter().map(|x| x * x).sum();
            close(file.component("strain", 0)[jelly], row, "b_xx");
        }
    }
}

/// All formats hold the same particles: the last value of each is where its format says it is.
#[test]
fn the_formats_agree_on_the_last_particle() {
    let folder = tempfile::tempdir().unwrap();
    let mut simulation = sand_and_jelly(Precision::F32);
    simulation.step().unwrap();
    let n = simulation.particle_count();
    let fields = Some(["velocity", "stress", "id"].as_slice());
    let npz = Archive::read(&export(&simulation, folder.path(), Export::Npz, fields));
    let names: Vec<&String> = npz.arrays.keys().collect();
    assert_eq!(names, ["header", "id", "position", "stress", "time", "velocity"]);
    let (last, speed) = (npz.component("position", 2)[n - 1], npz.component("velocity", 2)[n - 1]);

    let ply = std::fs::read(export(&simulation, folder.path(), Export::Ply, fields)).unwrap();
    let start = ply.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let head = std::str::from_utf8(&ply[..start]).unwrap();
    for line in [
        "comment unit of stress: Pa",
        "property double x",
        "property float vx",
        "property float stress_xy",
        "property uint id",
    ] {
        assert!(head.lines().any(|l| l == line), "{line} is not in\n{head}");
    }
    let row = 24 + 12 + 24 + 4;
    assert_eq!(ply.len() - start, n * row);
    let at = start + (n - 1) * row + 16;
    assert_eq!(f64::from_le_bytes(ply[at..at + 8].try_into().unwrap()), last);
    assert_eq!(f64::from(f32::from_le_bytes(ply[at + 16..at + 20].try_into().unwrap())), speed);

    let vtu = std::fs::read(export(&simulation, folder.path(), Export::Vtk, fields)).unwrap();
    let mark = b"<AppendedData encoding=\"raw\">\n_";
    let data = vtu.windows(mark.len()).position(|w| w == mark).unwrap() + mark.len();
    let head = std::str::from_utf8(&vtu[..data - 1]).unwrap();
    let offset = |name: &str| -> usize {
        let element = head.split(&format!("Name=\"{name}\"")).nth(1).unwrap();
        element.split("offset=\"").nth(1).unwrap().split('"').next().unwrap().parse().unwrap()
    };
    let at = data + offset("velocity");
    assert_eq!(u64::from_le_bytes(vtu[at..at + 8].try_into().unwrap()), 12 * n as u64);
    let at = at + 8 + 12 * (n - 1) + 8;
    assert_eq!(f64::from(f32::from_le_bytes(vtu[at..at + 4].try_into().unwrap())), speed);
    assert!(
        head.contains("Name=\"TimeValue\"") && head.contains(">Pa</InformationKey>") && vtu.ends_with(b"</VTKFile>\n")
    );

    let wrong = Fields::new(simulation.plan(), Some(&["speed".to_owned()])).unwrap_err().to_string();
    assert!(
        wrong.contains("output.export_fields") && wrong.contains("'speed'") && wrong.contains("velocity"),
        "{wrong}"
    );
}

/// A bed 10 cm deep, with what it writes.
fn bed(output: &str) -> Scene {
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"slip\"";
    scene(&Head::cells(0.02, [10, 8, 10], walls).with(&[
        material("sand", 1500.0, "young_modulus = 1e6, poisson_ratio = 0.2, friction_angle_deg = 30.0"),
        block("sand", [0.0; 3], [0.2, 0.16, 0.1], "settled = true"),
        output.to_owned(),
    ]))
}

fn go(scene: &Scene, out: &Path, end: f64) -> barchan::Result<()> {
    let options = Options { threads: 1, ..Options::default() };
    let snapshot = out.join("snapshot.barchan");
    let (existing, mut simulation) = if snapshot.is_file() {
        (Existing::Resume, Simulation::resume(&barchan::registry(), &snapshot, &options)?)
    } else {
        (Existing::Refuse, Simulation::new(&barchan::registry(), scene, &options)?)
    };
    let request =
        Request { out: out.to_owned(), until: Until::Time(end), pictures: false, export: None, existing, swap: None };
    run(&mut simulation, &request, &mut |_| ControlFlow::Continue(())).map(drop)
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// A run writes the ground's surface and height at intervals of their own, and goes on where it was cut. Ground that was filled 10 cm deep is 10 cm high, and
/// its surface holds its volume. A trace as arrays is the trace.
#[test]
fn surface_height_and_arrays_of_the_trace_are_those_of_the_run() {
    let output = "[output]\nsurface = { interval = 0.02 }\nheight_map = { interval = 0.01, spacing = 0.04, png = true }\n\
                  trace = { interval = 0.01, npz = true, parquet = true }\n";
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let scene = bed(output);
    go(&scene, &out, 0.011).unwrap();
    go(&scene, &out, 0.031).unwrap();
    assert_eq!(names(&out.join("surface")), ["00000.ply", "00001.ply"]);
    let maps: Vec<String> = (0..4).flat_map(|i| ["npz", "png"].map(|end| format!("{i:05}.{end}"))).collect();
    assert_eq!(names(&out.join("height")), maps);

    let map = Archive::read(&out.join("height/00003.npz"));
    assert_eq!(map.arrays["height"].0, [4, 5]);
    assert!(map.of("height").iter().all(|z| (z - 0.1).abs() < 1e-3), "{:?}", map.of("height"));
    assert!((map.of("x")[1] - 0.06).abs() < 1e-12 && (map.of("y")[3] - 0.14).abs() < 1e-12);

    let ply = std::fs::read(out.join("surface/00001.ply")).unwrap();
    let start = ply.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let head = std::str::from_utf8(&ply[..start]).unwrap();
    let count = |what: &str| -> usize {
        head.split(&format!("element {what} ")).nth(1).unwrap().lines().next().unwrap().parse().unwrap()
    };
    assert_eq!(ply.len() - start, 24 * count("vertex") + 13 * count("face"));
    let heights = ply[start..][..24 * count("vertex")].as_chunks::<24>().0.iter();
    let top = heights.map(|v| f64::from_le_bytes(v[16..].try_into().unwrap())).fold(0.0, f64::max);
    assert!((top - 0.1).abs() < 1e-3, "the surface is {top} m high");

    let text = std::fs::read_to_string(out.join("trace.csv")).unwrap();
    let arrays = Archive::read(&out.join("trace.npz"));
    let mut lines = text.lines();
    let columns: Vec<&str> = lines.next().unwrap().split(',').collect();
    let rows: Vec<Vec<f64>> =
        lines.map(|line| line.split(',').map(|x| x.parse().unwrap_or(f64::NAN)).collect()).collect();
    assert!(rows.len() >= 4 && arrays.arrays.len() == columns.len());
    for (c, name) in columns.iter().enumerate() {
        let column: Vec<f64> = rows.iter().map(|row| row[c]).collect();
        assert_eq!(format!("{column:?}"), format!("{:?}", arrays.of(name)), "{name}");
    }
    // Rows of a Parquet file are numbers or null.
    let file = SerializedFileReader::new(std::fs::File::open(out.join("trace.parquet")).unwrap()).unwrap();
    let read: Vec<_> = file.get_row_iter(None).unwrap().map(|row| row.unwrap()).collect();
    assert_eq!(read.len(), rows.len());
    for (read, row) in read.iter().zip(&rows) {
        for ((name, field), (wanted, value)) in read.get_column_iter().zip(columns.iter().zip(row)) {
            let there = if let Field::Double(there) = field { *there } else { f64::NAN };
            assert!(
                name == wanted && (there == *value || there.is_nan() && value.is_nan()),
                "{name}: {there}, {value}"
            );
        }
    }
}

/// Grids that cannot be made are refused where the scene says them.
#[test]
fn grids_too_fine_for_the_ground_are_refused() {
    let check = |output: &str| {
        let text = Head::cells(0.02, [10, 8, 10], "").with(&[format!("[output]\n{output}\n")]);
        Scene::from_str(&text, "case.toml", "").and_then(|mut scene| scene.check()).unwrap_err().to_string()
    };
    let error = check("surface = { interval = 0.1, spacing = 1e-3 }");
    assert!(error.contains("output.surface.spacing") && error.contains("half a cell, 0.01 m"), "{error}");
    let error = check("height_map = { interval = 0 }");
    assert!(error.contains("output.height_map.interval"), "{error}");
    let mut wide = bed("[output]\nheight_map = { interval = 0.1, spacing = 0.01 }\n");
    wide.world.max = [40.0, 40.0, 20.0];
    let error = wide.check().unwrap_err().to_string();
    assert!(error.contains("output.height_map.spacing") && error.contains("make it"), "{error}");
}

/// A particle of a snapshot as the document lays it out: number, position, velocity, mass, strain.
type Documented = (u64, [f64; 3], [f64; 3], f64, Vec<f64>);

/// The particles of a snapshot, read by `docs/formats.md`: id, position, velocity, mass and strain.
fn by_the_document(bytes: &[u8]) -> Vec<Documented> {
    assert_eq!((&bytes[..8], &bytes[8..12]), (b"BARCHAN\x1a".as_slice(), 7u32.to_le_bytes().as_slice()));
    let u64_at = |b: &[u8], at: usize| u64::from_le_bytes(b[at..at + 8].try_into().unwrap());
    let (mut at, mut rows) = (12, Vec::new());
    loop {
        let (tag, length) = (&bytes[at..at + 4], u64_at(bytes, at + 4) as usize);
        let checksum = u32::from_le_bytes(bytes[at + 12..at + 16].try_into().unwrap());
        let data = &bytes[at + 16..][..length];
        assert_eq!(crc32fast::hash(data), checksum);
        at += 16 + length;
        match tag {
            b"HEAD" => assert!(serde_json::from_slice::<serde_json::Value>(data).unwrap()["time"].is_f64()),
            b"LIST" => {
                let u32_at = |at: usize| u32::from_le_bytes(data[at..at + 4].try_into().unwrap());
                let (planes, width, n) = (u32_at(12), f64::from_bits(u64_at(data, 20)), u64_at(data, 28) as usize);
                let ids: Vec<u64> = (0..n).map(|i| u64_at(data, 36 + 8 * i)).collect();
                let cells = 36 + 10 * n;
                let mut next = cells + 12 * n;
                let mut plane = |count: usize| -> Vec<f64> {
                    let (form, from) = (data[next], next + 1);
                    let four = |i: usize| data[from + 4 * i..][..4].try_into().unwrap();
                    let eight = |i: usize| f64::from_bits(u64_at(data, from + 8 * i));
                    next = from + [4 * count, 8 * count, 4 * count, 8][usize::from(form)];
                    let value = |i: usize| match form {
                        0 => f64::from(f32::from_le_bytes(four(i))),
                        1 => eight(i),
                        2 => f64::from(u32::from_le_bytes(four(i))) / 2f64.powi(32),
                        _ => eight(0),
                    };
                    (0..count).map(value).collect()
                };
                let [offset, velocity] = [plane(3 * n), plane(3 * n)];
                let _affine = plane(9 * n);
                let [mass, _volume0] = [plane(n), plane(n)];
                let strain: Vec<Vec<f64>> = (0..planes).map(|_| plane(n)).collect();
                for i in 0..n {
                    let cell = |d: usize| f64::from(u32_at(cells + 12 * i + 4 * d) as i32);
                    let position = std::array::from_fn(|d| (cell(d) + offset[3 * i + d]) * width);
                    let velocity = std::array::from_fn(|d| velocity[3 * i + d]);
                    rows.push((ids[i], position, velocity, mass[i], strain.iter().map(|plane| plane[i]).collect()));
                }
            }
            b"END " => return rows,
            _ => {}
        }
    }
}

/// Who reads a snapshot by the document gets the particles, bit for bit.
#[test]
fn a_snapshot_is_what_the_document_says() {
    for precision in [Precision::F32, Precision::F64] {
        let folder = tempfile::tempdir().unwrap();
        let mut simulation = sand_and_jelly(precision);
        (0..3).for_each(|_| drop(simulation.step().unwrap()));
        let path = folder.path().join("state.barchan");
        simulation.save(&path).unwrap();
        let read = by_the_document(&std::fs::read(path).unwrap());
        let state = simulation.particles();
        let all = state.lists.iter().flat_map(|list| (0..list.len()).map(move |i| (list, i)));
        let mut count = 0;
        for ((list, i), (id, position, velocity, mass, strain)) in all.zip(&read) {
            assert_eq!(
                (list.id[i], list.position(i), list.velocity[i], list.mass[i]),
                (*id, *position, *velocity, *mass)
            );
            assert!(list.strain.iter().zip(strain).all(|(plane, x)| plane[i] == *x));
            count += 1;
        }
        assert_eq!((count, read.len()), (simulation.particle_count(), count));
    }
}

/// The document names every field, key and section that there is.
#[test]
fn the_document_names_every_field() {
    let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/formats.md")).unwrap();
    let simulation = sand_and_jelly(Precision::F32);
    for name in Fields::new(simulation.plan(), None).unwrap().names().filter(|name| !name.starts_with("history_")) {
        assert!(text.contains(&format!("`{name}`")), "docs/formats.md does not name the field {name}");
    }
    for key in ["export", "export_fields", "surface", "height_map", "trace.npz", "trace.parquet"] {
        assert!(text.contains(&format!("output.{key}")) || text.contains(&format!("{key} = ")), "{key}");
    }
}
