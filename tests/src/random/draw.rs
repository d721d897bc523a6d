//! Drawing scenes from their declarations.

mod laboratory;

use crate::scenes::Noise;
use barchan::parameter::{Kind, Parameter, Range};
use barchan::{Registry, Scene};
use std::fs;
use std::io;
use std::path::Path;
use toml::{Table, Value};

type Json = serde_json::Value;

/// The meshes, heights and pictures that scenes name, by file.
const FILES: [(&str, &[u8]); 9] = [
    (
        "cube.obj",
        b"v -1 -1 -1\nv 1 -1 -1\nv 1 1 -1\nv -1 1 -1\nv -1 -1 1\nv 1 -1 1\nv 1 1 1\nv -1 1 1\nf 1 4 3 2\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n",
    ),
    ("tetra.obj", b"v 1 1 1\nv 1 -1 -1\nv -1 1 -1\nv -1 -1 1\nf 1 2 3\nf 1 4 2\nf 1 3 4\nf 2 4 3\n"),
    // Open at the top, with walls.
    ("bucket.obj", b"v -0.15 -0.15 0\nv 0.15 -0.15 0\nv 0.15 0.15 0\nv -0.15 0.15 0\nv -0.15 -0.15 0.2\nv 0.15 -0.15 0.2\nv 0.15 0.15 0.2\nv -0.15 0.15 0.2\nv -0.11 -0.11 0.2\nv 0.11 -0.11 0.2\nv 0.11 0.11 0.2\nv -0.11 0.11 0.2\nv -0.11 -0.11 0.04\nv 0.11 -0.11 0.04\nv 0.11 0.11 0.04\nv -0.11 0.11 0.04\nf 4 3 2 1\nf 13 14 15 16\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\nf 5 6 10 9\nf 6 7 11 10\nf 7 8 12 11\nf 8 5 9 12\nf 9 10 14 13\nf 10 11 15 14\nf 11 12 16 15\nf 12 9 13 16\n"),
    ("loader.urdf", LOADER),
    ("pail.urdf", PAIL),
    ("cloud.csv", b"x,y,z\n0.1,0.1,0.1\n0.3,0.2,0.1\n"),
    ("point.csv", b"0,0,0\n"),
    ("heights.csv", b"0.4,0.6,0.5\n0.7,1.0,0.6\n0.5,0.8,0.4\n"),
    // Two by two pixels: black and white, below them two greys.
    (
        "map.png",
        b"\x89\x50\x4e\x47\x0d\x0a\x1a\x0a\x00\x00\x00\x0d\x49\x48\x44\x52\x00\x00\x00\x02\x00\x00\x00\x02\x08\
      \x00\x00\x00\x00\x57\xdd\x52\xf8\x00\x00\x00\x0e\x49\x44\x41\x54\x78\xda\x63\x60\xf8\xcf\xd0\xe0\x00\
      \x00\x05\x42\x01\xc0\x6d\x5e\x78\xa0\x00\x00\x00\x00\x49\x45\x4e\x44\xae\x42\x60\x82",
    ),
];

/// A robot with meshes: a body, an arm, and a bucket at its end.
const LOADER: &[u8] = br#"<robot name="loader">
  <link name="body">
    <inertial><mass value="8"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><mesh filename="cube.obj" scale="0.2 0.15 0.1"/></geometry></collision>
  </link>
  <link name="arm">
    <inertial><origin xyz="0.2 0 0"/><mass value="1"/><inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.05 0.05"/></geometry></collision>
  </link>
  <link name="bucket">
    <inertial><origin xyz="0 0 0.08"/><mass value="2"/><inertia ixx="0.03" iyy="0.03" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><mesh filename="bucket.obj"/></geometry></collision>
    <collision><origin xyz="0.17 0 0.1"/><geometry><mesh filename="tetra.obj" scale="0.04 -0.04 0.04"/></geometry></collision>
  </link>
  <joint name="lift" type="revolute">
    <parent link="body"/><child link="arm"/><origin xyz="0.2 0 0.05"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="200" velocity="5"/>
  </joint>
  <joint name="tilt" type="revolute">
    <parent link="arm"/><child link="bucket"/><origin xyz="0.55 0 -0.1"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="50" velocity="5"/>
  </joint>
</robot>
"#;

/// Another: a bucket that slides down from a body.
const PAIL: &[u8] = br#"<robot name="pail">
  <link name="body">
    <inertial><mass value="3"/><inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><mesh filename="tetra.obj" scale="0.1 0.1 0.1"/></geometry></collision>
  </link>
  <link name="bucket">
    <inertial><origin xyz="0 0 0.08"/><mass value="2"/><inertia ixx="0.03" iyy="0.03" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><mesh filename="bucket.obj"/></geometry></collision>
  </link>
  <joint name="down" type="prismatic">
    <parent link="body"/><child link="bucket"/><origin xyz="0 0 -0.4"/><axis xyz="0 0 1"/><limit lower="-0.2" upper="0.1" effort="100" velocity="2"/>
  </joint>
</robot>
"#;

/// Writes the files that scenes name into a folder.
///
/// # Errors
/// What the file system says.
pub fn write_files(folder: &Path) -> io::Result<()> {
    FILES.iter().try_for_each(|(name, text)| fs::write(folder.join(name), text))
}

/// Draws scenes.
pub struct Generator {
    schema: Json,
    /// Name and parameters of each law.
    laws: Vec<(String, Vec<Parameter>)>,
    /// Likewise of couplings that scenes may call for by name, and of tasks.
    couplings: Vec<(String, Vec<Parameter>)>,
    tasks: Vec<(String, Vec<Parameter>)>,
}

/// What a scene's numbers are drawn to fit: everything is small enough to be run in no time.
struct Frame {
    noise: Noise,
    /// Finest cell [m].
    cell: f64,
    /// Extent of the world in cells, and its least corner.
    cells: [i64; 3],
    first: [i64; 3],
    levels: u32,
    /// Greatest speed [m/s].
    speed: f64,
    materials: usize,
    bodies: usize,
    tools: usize,
    /// Index of the entry of a list that is being drawn.
    entry: usize,
}

impl Frame {
    fn uniform(&mut self) -> f64 {
        0.5 + 0.5 * self.noise.draw()
    }
    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + self.uniform() * (high - low)
    }
    /// As likely in each decade.
    fn decades(&mut self, low: f64, high: f64) -> f64 {
        (self.between(low.ln(), high.ln())).exp()
    }
    fn below(&mut self, count: usize) -> usize {
        ((self.uniform() * count as f64) as usize).min(count.saturating_sub(1))
    }
    fn is(&mut self, chance: f64) -> bool {
        self.uniform() < chance
    }
    fn pick<T: Clone>(&mut self, from: &[T]) -> T {
        from[self.below(from.len())].clone()
    }
    /// A length of some cells [m], now and then of whole ones.
    fn length(&mut self, low: f64, high: f64) -> f64 {
        let cells = self.between(low, high);
        self.cell * if self.is(0.3) { cells.round().max(1.0) } else { cells }
    }
    /// A point of the world [m], so many cells away from its sides.
    fn point(&mut self, margin: f64) -> [f64; 3] {
        std::array::from_fn(|d| {
            let (low, high) = (self.first[d] as f64 + margin, (self.first[d] + self.cells[d]) as f64 - margin);
            let at = self.between(low, high.max(low));
            self.cell * if self.is(0.3) { at.round() } else { at }
        })
    }
    /// A direction of any length up to 1; now and then along an axis, or none.
    fn direction(&mut self) -> [f64; 3] {
        match self.below(4) {
            0 => [0.0; 3],
            1 => {
                let axis = self.below(3);
                std::array::from_fn(|d| if d == axis { self.pick(&[-1.0, 1.0]) } else { 0.0 })
            }
            _ => std::array::from_fn(|_| self.noise.draw()),
        }
    }
}

fn floats(values: impl IntoIterator<Item = f64>) -> Value {
    Value::Array(values.into_iter().map(Value::Float).collect())
}

impl Generator {
    /// A generator for what a registry knows.
    pub fn new(registry: &Registry) -> Self {
        let laws = registry.materials().map(|law| (law.name.clone(), law.parameters.clone())).collect();
        let of_scene = barchan::plan::SCENE_COUPLINGS;
        let named = registry.couplings().filter(|(name, _)| !of_scene.contains(name));
        let couplings = named.map(|(name, kind)| (name.to_owned(), kind.parameters.clone())).collect();
        let tasks = registry.tasks().map(|(name, kind)| (name.to_owned(), kind.parameters.clone())).collect();
        let mut schema = Scene::schema();
        // Robots name joints and links of their files, and sources and sinks have to fit into the world: they are put together here, in `robot` and `flow`.
        // A probe measures one thing of those that it could, where there is something: likewise, in `probe`.
        if let Some(keys) = schema["properties"].as_object_mut() {
            ["robot", "source", "sink", "clip", "probe"].iter().for_each(|key| drop(keys.remove(*key)));
        }
        // So do boxes of levels, and what is seldom asked of bodies, tools and the world: see `laboratory`.
        for (of, key) in [
            ("Levels", "box"),
            ("Body", "velocity_gradient"),
            ("Body", "k0"),
            ("Tool", "from"),
            ("Tool", "until"),
            ("World", "plane_strain"),
        ] {
            schema["$defs"][of]["properties"].as_object_mut().map(|keys| keys.remove(key));
        }
        if let Some(motions) = schema["$defs"]["Motion"]["oneOf"].as_array_mut() {
            motions.retain(|motion| motion["properties"].get("servo").is_none());
        }
        Self { schema, laws, couplings, tasks }
    }

    /// The scene of a seed, as TOML. Not all of them can be run.
    pub fn scene(&self, seed: u64) -> Table {
        let mut noise = Noise::new(seed.wrapping_add(1));
        // Seeds that lie side by side begin alike.
        for _ in 0..8 {
            noise.draw();
        }
        let mut frame = Frame {
            noise,
            cell: 0.0,
            cells: [0; 3],
            first: [0; 3],
            levels: 1,
            speed: 0.0,
            materials: 0,
            bodies: 0,
            tools: 0,
            entry: 0,
        };
        frame.cell = frame.pick(&[1e-3, 0.01, 0.02, 0.03, 0.05, 0.1, 1.0]);
        frame.levels = frame.pick(&[1, 1, 1, 2, 2, 3, 4]);
        let unit = 4 << (frame.levels - 1);
        frame.cells = std::array::from_fn(|_| ((16 + 8 * frame.below(3) as i64) / unit).max(1) * unit);
        let far = frame.pick(&[0, 0, 0, -20, 400_000]);
        frame.first = std::array::from_fn(|_| if frame.is(0.5) { 0 } else { far / unit * unit });
        frame.speed = frame.cell.sqrt() * frame.decades(0.1, 10.0);
        frame.materials = 1 + frame.below(3);
        frame.bodies = frame.pick(&[0, 1, 1, 1, 2, 2, 3]);
        frame.tools = frame.pick(&[0, 1, 1, 2, 3]);
        let Value::Table(mut scene) = self.object(&self.schema, "", &mut frame) else { return Table::new() };
        let add_parameters = |entry: &mut Table, name: &str, known: &[(String, Vec<Parameter>)], frame: &mut Frame| {
            let is_named = |known: &&(String, Vec<Parameter>)| entry[name].as_str() == Some(&known.0);
            let parameters = known.iter().find(is_named).map(|known| Self::parameters(&known.1, frame));
            entry.insert("parameters".to_owned(), Value::Table(parameters.unwrap_or_default()));
        };
        for (list, name, known) in [("material", "law", &self.laws), ("coupling", "kind", &self.couplings)] {
            entries(&mut scene, list).for_each(|entry| add_parameters(entry, name, known, &mut frame));
        }
        if let Some(task) = within(&mut scene, "task") {
            add_parameters(task, "name", &self.tasks, &mut frame);
        }
        // Most scenes are to run: what types and units cannot say is mended.
        if !frame.is(0.05) {
            mend(&mut scene, &mut frame);
        }
        if frame.is(0.15) {
            let first = robot(&mut frame, "r0");
            if frame.is(0.5) {
                let beside = company(&mut frame, &first);
                let tools = scene.entry("tool").or_insert_with(|| Value::Array(Vec::new()));
                tools.as_array_mut().into_iter().for_each(|tools| tools.push(Value::Table(beside.clone())));
            }
            let mut robots = vec![Value::Table(first)];
            if frame.is(0.25) {
                robots.push(Value::Table(robot(&mut frame, "r1")));
            }
            scene.insert("robot".to_owned(), Value::Array(robots));
        }
        if frame.is(0.15) {
            let [source, sink] = flow(&mut frame);
            scene.insert("source".to_owned(), Value::Array(vec![Value::Table(source)]));
            scene.insert("sink".to_owned(), Value::Array(vec![Value::Table(sink)]));
        }
        if frame.is(0.2) {
            scene.insert("clip".to_owned(), Value::Boolean(frame.is(0.5)));
        }
        for body in
            entries(&mut scene, "body").filter(|body| !body.contains_key("zone") && !body.contains_key("settled"))
        {
            if frame.is(0.1) {
                let most = frame.speed / (8.0 * frame.cell);
                let gradient = floats((0..9).map(|_| most * frame.noise.draw()).collect::<Vec<_>>());
                body.insert("velocity_gradient".to_owned(), gradient);
            }
        }
        if frame.levels > 1 && frame.is(0.15) {
            let (a, b) = (frame.point(0.0), frame.point(0.0));
            let ends = [("min", f64::min as fn(f64, f64) -> f64), ("max", f64::max)];
            let ends = ends.map(|(key, f)| (key.to_owned(), floats([0, 1, 2].map(|d| f(a[d], b[d])))));
            if let Some(levels) = within(&mut scene, "levels") {
                levels.insert("box".to_owned(), Value::Array(vec![Value::Table(ends.into_iter().collect())]));
            }
        }
        laboratory::add(&mut scene, &mut frame);
        if frame.is(0.3) {
            let count = 1 + frame.below(3);
            let probes = (0..count).map(|i| Value::Table(probe(i, &scene, &mut frame))).collect();
            scene.insert("probe".to_owned(), Value::Array(probes));
        }
        scene
    }

    /// What a declaration refers to.
    fn resolved<'a>(&'a self, declared: &'a Json) -> &'a Json {
        let name = declared["$ref"].as_str().and_then(|path| path.strip_prefix("#/$defs/"));
        name.map_or(declared, |name| &self.schema["$defs"][name])
    }

    fn object(&self, declared: &Json, path: &str, frame: &mut Frame) -> Value {
        let required = declared["required"].as_array();
        let is_required = |key: &str| required.is_some_and(|keys| keys.iter().any(|k| k == key));
        let mut table = Table::new();
        for (key, property) in declared["properties"].as_object().into_iter().flatten() {
            let below = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
            if is_required(key) || frame.is(wanted(&below)) {
                let doc = property["description"].as_str().unwrap_or_default();
                if let Some(value) = self.value(property, &below, doc, frame) {
                    table.insert(key.clone(), value);
                }
            }
        }
        Value::Table(table)
    }

    /// A value for a key.
    fn value(&self, declared: &Json, path: &str, doc: &str, frame: &mut Frame) -> Option<Value> {
        if let Some(value) = self.known(path, frame) {
            return value;
        }
        let declared = self.resolved(declared);
        if let Some(choices) = declared["oneOf"].as_array() {
            let all: Vec<&Json> = choices.iter().filter(|choice| is_open(choice, path)).collect();
            let chosen = frame.pick(&all);
            return match chosen["const"].as_str() {
                Some(word) => Some(Value::String(word.to_owned())),
                None => self.value(chosen, path, doc, frame),
            };
        }
        // Of what may be absent, what is there.
        if let Some(choices) = declared["anyOf"].as_array() {
            let present = choices.iter().find(|choice| choice["type"] != "null")?;
            return self.value(present, path, doc, frame);
        }
        if let Some(words) = declared["enum"].as_array() {
            return frame.pick(words).as_str().map(|word| Value::String(word.to_owned()));
        }
        let kind = match &declared["type"] {
            Json::String(kind) => kind.as_str(),
            Json::Array(kinds) => kinds.iter().filter_map(Json::as_str).find(|kind| *kind != "null")?,
            _ => return None,
        };
        let doc = declared["description"].as_str().unwrap_or(doc);
        Some(match kind {
            "boolean" => Value::Boolean(frame.is(0.5)),
            "string" => Value::String(format!("text {}", frame.below(100))),
            "integer" => {
                let least = declared["minimum"].as_i64().unwrap_or(0);
                Value::Integer(least + frame.below(20) as i64)
            }
            "number" => Value::Float(self.number(doc, frame)),
            "object" => self.object(declared, path, frame),
            "array" => {
                let count = declared["minItems"].as_u64();
                match count {
                    Some(count) => self.vector(count as usize, doc, frame),
                    None => self.list(&declared["items"], path, frame),
                }
            }
            _ => return None,
        })
    }

    /// A number, by its unit.
    fn number(&self, doc: &str, frame: &mut Frame) -> f64 {
        match unit(doc) {
            "m" => frame.length(0.5, 3.0),
            "m/s" => frame.speed * frame.uniform(),
            "rad/s" => frame.speed / (4.0 * frame.cell) * frame.uniform(),
            "s" => frame.decades(1e-4, 0.1),
            "kg" => 1000.0 * (2.0 * frame.cell).powi(3) * frame.decades(1e-2, 1e2),
            "kg/m³" => frame.pick(&[1000.0, 1600.0, 400.0, 7800.0, 2.0]),
            "Pa" => frame.decades(1e3, 1e7),
            _ => frame.pick(&[0.0, 0.25, 0.5, 1.0, 3.0]) * frame.uniform().round().max(0.5),
        }
    }

    fn vector(&self, count: usize, doc: &str, frame: &mut Frame) -> Value {
        match (count, unit(doc)) {
            (4, _) => floats(std::array::from_fn::<f64, 4, _>(|_| frame.noise.draw())),
            (_, "m") => floats(frame.point(3.0).into_iter().take(count)),
            (_, "m/s") => floats(frame.direction().map(|x| x * frame.speed).into_iter().take(count)),
            (_, "rad/s") => {
                let most = frame.speed / (4.0 * frame.cell);
                floats(frame.direction().map(|x| x * most).into_iter().take(count))
            }
            _ => floats((0..count).map(|_| frame.noise.draw()).collect::<Vec<_>>()),
        }
    }

    fn list(&self, items: &Json, path: &str, frame: &mut Frame) -> Value {
        let count = match path {
            "material" => frame.materials,
            "body" => frame.bodies,
            "tool" => frame.tools,
            "coupling" => {
                if self.couplings.is_empty() {
                    0
                } else {
                    1 + frame.below(2)
                }
            }
            _ => 1 + frame.below(3),
        };
        let entry = |i: usize, frame: &mut Frame| {
            let before = std::mem::replace(&mut frame.entry, i);
            let value = self.value(items, &format!("{path}[]"), "", frame);
            frame.entry = if path.contains('[') { before } else { i };
            value
        };
        Value::Array((0..count).filter_map(|i| entry(i, frame)).collect())
    }

    /// What is known of some keys beyond their types and units; `Some(None)` leaves the key out.
    fn known(&self, path: &str, frame: &mut Frame) -> Option<Option<Value>> {
        let text = |text: String| Some(Some(Value::String(text)));
        let number = |number: f64| Some(Some(Value::Float(number)));
        let named = |i: usize, prefix: &str| Value::String(format!("{prefix}{i}"));
        // Where a tool's shape stands in its own frame, and a soft body's in the world.
        let of_tool = path.starts_with("tool[]");
        match path {
            "name" => return text("random".to_owned()),
            "material[].name" => return text(format!("m{}", frame.entry)),
            "body[].name" => return text(format!("b{}", frame.entry)),
            "tool[].name" => return text(format!("t{}", frame.entry)),
            "seed" => return Some(Some(Value::Integer(frame.pick(&[0, 1, 77, i64::MAX])))),
            "gravity" => {
                let all = [[0.0; 3], [0.0, 0.0, -9.81], [0.0, 0.0, -9.81], [3.0, 0.0, -9.0], [-5.0, 5.0, 0.0]];
                return Some(Some(floats(frame.pick(&all))));
            }
            "world.cell" => return number(frame.cell),
            "world.min" => return Some(Some(floats(frame.first.map(|c| c as f64 * frame.cell)))),
            "world.max" => {
                let ends: [i64; 3] = std::array::from_fn(|d| frame.first[d] + frame.cells[d]);
                return Some(Some(floats(ends.map(|c| c as f64 * frame.cell))));
            }
            "levels.count" => return Some(Some(Value::Integer(frame.levels.into()))),
            "levels.half" => return Some(Some(Value::Integer(frame.pick(&[8, 8, 10, 12, 16])))),
            "levels.reach" => return Some(Some(Value::Integer(frame.pick(&[0, 0, 0, 4, 6])))),
            "levels.tolerance" => return number(frame.pick(&[0.0, 0.01, 0.1, 1.0])),
            "levels.agents" => {
                let all = (0..frame.bodies).map(|i| named(i, "b")).chain((0..frame.tools).map(|i| named(i, "t")));
                let all: Vec<Value> = all.collect();
                let some: Vec<Value> = all.into_iter().filter(|_| frame.is(0.5)).collect();
                return Some(Some(Value::Array(some.into_iter().map(|name| agent(name, frame)).collect())));
            }
            "sleep.speed" => return number(frame.speed * frame.decades(1e-4, 1.0)),
            "time.end" => return number(1000.0),
            "time.step" => return number(frame.decades(1e-6, 1e-2)),
            "time.safety" => return number(frame.pick(&[0.3, 0.6, 0.9, 1.0])),
            "output.surface.interval" | "output.height_map.interval" => return number(frame.decades(1e-3, 1.0)),
            "output.surface.spacing" | "output.height_map.spacing" => {
                return number(frame.cell * frame.pick(&[0.5, 1.0, 2.5]));
            }
            "output.picture.pixels" => return Some(Some(Value::Integer(16 + frame.below(200) as i64))),
            "output.picture.cut_y" => return number(frame.point(1.0)[1]),
            "output.picture.camera.fov_deg" => return number(frame.pick(&[1.0, 20.0, 45.0, 150.0])),
            "output.picture.camera.follow" if frame.tools == 0 => return Some(None),
            "output.picture.camera.follow" => return text(format!("t{}", frame.below(frame.tools))),
            "material[].damping" => return number(frame.decades(1e-6, 1e-2)),
            "material[].law" => {
                let law = frame.pick(&self.laws);
                return text(law.0);
            }
            // Once the law is known.
            "material[].parameters" | "coupling[].parameters" | "task.parameters" => {
                return Some(Some(Value::Table(Table::new())));
            }
            "coupling[].kind" => return text(frame.pick(&self.couplings).0),
            "coupling[].name" => return text(format!("c{}", frame.entry)),
            "task" if self.tasks.is_empty() => return Some(None),
            "task.name" => return text(frame.pick(&self.tasks).0),
            "body[].material" => return text(format!("m{}", frame.below(frame.materials))),
            "body[].zone[].picture.file" => return text("map.png".to_owned()),
            "body[].zone[].picture.grey" => {
                let least = frame.pick(&[0.0, 0.2, 0.6]);
                return Some(Some(floats([least, least + frame.pick(&[0.0, 0.1, 0.4])])));
            }
            "body[].zone[].material" => return text(format!("m{}", frame.below(frame.materials))),
            "body[].spacing" => {
                let cells = frame.pick(&[0.5, 0.5, 0.5, 0.34, 0.66, 1.0]);
                return number(cells * frame.cell);
            }
            "tool[].motion.free.restitution" => return number(frame.pick(&[0.0, 0.5, 1.0])),
            _ => {}
        }
        let (_, shape) = path.split_once(".shape.")?;
        let key = shape.rsplit_once("shape.").map_or(shape, |(_, inner)| inner);
        let of_union = shape.contains("union");
        match key {
            "box" => Some(Some(self.cuboid(of_tool, frame))),
            "height_field.min" => Some(Some(floats([-1.0, -1.0]))),
            "height_field.max" => Some(Some(floats([1.0, 1.0]))),
            "height_field.bottom" => number(-0.5),
            "height_field.heights" => {
                let row = |frame: &mut Frame| floats((0..3).map(|_| 0.2 + 0.3 * frame.uniform()).collect::<Vec<_>>());
                Some(Some(Value::Array((0..2).map(|_| row(frame)).collect())))
            }
            "height_field.file" => text("heights.csv".to_owned()),
            "terrain.surface.slope.slope_deg" => number(frame.between(-10.0, 10.0)),
            "terrain.surface.dunes.lee_deg" => number(frame.pick(&[10.0, 20.0, 30.0, 45.0])),
            "terrain.surface.stairs.count" => Some(Some(Value::Integer(1 + frame.below(2) as i64))),
            _ if key.starts_with("terrain") && key.ends_with("_deg") => number(frame.pick(&[0.0, 90.0, 270.0, 33.0])),
            "mesh.file" => text(frame.pick(&["cube.obj", "tetra.obj"]).to_owned()),
            "mesh.scale" => number(frame.length(0.6, 2.0)),
            _ if key.ends_with(".center") && (of_tool || of_union) => {
                Some(Some(floats(frame.direction().map(|x| x * frame.cell))))
            }
            // So far from the sides that few bodies reach out of the world.
            _ if key.ends_with(".center") => Some(Some(floats(frame.point(5.0)))),
            _ if key.ends_with(".point") => Some(Some(floats([0.0; 3]))),
            _ if key.ends_with(".position") => Some(Some(floats(frame.direction().map(|x| 2.0 * x * frame.cell)))),
            _ => None,
        }
    }

    /// A box: the ground of the world now and then, if it is a soft body's.
    fn cuboid(&self, of_tool: bool, frame: &mut Frame) -> Value {
        let mut table = Table::new();
        let half: [f64; 3] = std::array::from_fn(|_| frame.length(0.5, 2.5));
        if frame.is(0.4) {
            table.insert("half".to_owned(), floats(half));
            if !of_tool || frame.is(0.2) {
                let center = frame.point(3.5);
                table.insert(
                    "center".to_owned(),
                    floats(if of_tool { frame.direction().map(|x| x * half[0]) } else { center }),
                );
            }
            return Value::Table(table);
        }
        if of_tool {
            table.insert("min".to_owned(), floats(half.map(|x| -x)));
            table.insert("max".to_owned(), floats(half));
            return Value::Table(table);
        }
        let (min, max): ([f64; 3], [f64; 3]) = if frame.is(0.4) {
            let depth = frame.length(1.0, 3.0);
            let ends = [0, 1, 2].map(|d| (frame.first[d], frame.first[d] + frame.cells[d]));
            let [x, y, z] = ends.map(|(low, high)| (low as f64 * frame.cell, high as f64 * frame.cell));
            ([x.0, y.0, z.0], [x.1, y.1, z.0 + depth])
        } else {
            let center = frame.point(3.5);
            (std::array::from_fn(|d| center[d] - half[d]), std::array::from_fn(|d| center[d] + half[d]))
        };
        table.insert("min".to_owned(), floats(min));
        table.insert("max".to_owned(), floats(max));
        Value::Table(table)
    }

    /// Parameters of one of some declarations: those that are required, and a few others at random.
    fn parameters(of: &[Parameter], frame: &mut Frame) -> Table {
        let mut table = Table::new();
        for parameter in of {
            let is_required = parameter.default.is_none() && !matches!(parameter.kind, Kind::Table(_));
            if !is_required && !frame.is(0.4) {
                continue;
            }
            if let Some(value) = Self::parameter(parameter, &parameter.kind, frame) {
                table.insert(parameter.name.clone(), value);
            }
        }
        table
    }

    /// A value of a parameter's type, or of its entries'.
    fn parameter(of: &Parameter, kind: &Kind, frame: &mut Frame) -> Option<Value> {
        Some(match kind {
            Kind::Number(range) => Value::Float(Self::parameter_number(of, range, frame)?),
            Kind::Switch => Value::Boolean(frame.is(0.5)),
            // A text names a tool, or something of its own.
            Kind::Text(choices) if choices.is_empty() => Value::String(match frame.is(0.5) {
                true => format!("t{}", frame.below(frame.tools + 1)),
                false => format!("text {}", frame.below(1000)),
            }),
            Kind::Text(choices) => Value::String(frame.pick(choices)),
            // Whatever a plugin reads, it is no mesh.
            Kind::Path => Value::String(frame.pick(&["heights.csv", "cube.obj"]).to_owned()),
            Kind::Array { of: entry, count } => {
                let count = count.start() + frame.below((count.end() - count.start()).min(2) + 1);
                Value::Array((0..count).filter_map(|_| Self::parameter(of, entry, frame)).collect())
            }
            Kind::Table(keys) => Value::Table(Self::parameters(keys, frame)),
        })
    }

    fn parameter_number(of: &Parameter, range: &Range, frame: &mut Frame) -> Option<f64> {
        let (low, high) = (range.min.max(-1e9), range.max.min(1e9));
        let near = match of.default_number() {
            Some(default) if default > 0.0 && low >= 0.0 => default * frame.decades(0.03, 3.0),
            _ => frame.between(low.max(-10.0), high.min(10.0)),
        };
        let value = match frame.below(8) {
            0 if range.contains(low) => low,
            1 if high <= 100.0 && range.contains(high) => high,
            _ => near,
        };
        range.contains(value).then_some(value)
    }

    /// All keys that a scene may have, entries of lists as `[]`: those below a union's parts once.
    pub fn keys(&self) -> Vec<String> {
        let mut keys = Vec::new();
        self.add_keys(&self.schema, "", &mut keys);
        keys.sort();
        keys.dedup();
        keys
    }

    fn add_keys(&self, declared: &Json, path: &str, keys: &mut Vec<String>) {
        let declared = self.resolved(declared);
        if path.matches("union").count() > 1 || path.matches("shape").count() > 2 {
            return;
        }
        for choice in ["oneOf", "anyOf"].iter().flat_map(|of| declared[of].as_array().into_iter().flatten()) {
            if is_open(choice, path) {
                self.add_keys(choice, path, keys);
            }
        }
        for (key, property) in declared["properties"].as_object().into_iter().flatten() {
            let below = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
            keys.push(below.clone());
            self.add_keys(property, &below, keys);
        }
        if declared["minItems"].is_null() && declared["items"].is_object() {
            self.add_keys(&declared["items"], &format!("{path}[]"), keys);
        }
    }
}

/// How often an optional key is set.
fn wanted(path: &str) -> f64 {
    match path {
        // What a scene is made of.
        "levels" | "levels.count" | "material" | "body" | "tool" | "tool[].position" | "material[].parameters" => 1.0,
        "body[].name" | "tool[].motion" => 0.9,
        "levels.half" => 1.0,
        // The origin is seldom in the world.
        _ if path.starts_with("body") && path.ends_with(".center") => 1.0,
        "time.step" | "task" => 0.05,
        "coupling" | "gravity_ramp" | "material[].damping" | "body[].settled" | "body[].zone" | "levels.reach"
        | "sleep" | "output" => 0.15,
        _ => 0.35,
    }
}

/// May a choice be drawn here? Bodies of several shapes would be empty as a rule, a soft body is no plane, and unions are one deep.
fn is_open(choice: &Json, path: &str) -> bool {
    let is = |name: &str| choice["properties"].get(name).is_some();
    let open = path.starts_with("body") || path.contains("union");
    !(is("difference") || is("intersection") || open && (is("union") || is("plane")))
}

/// The last unit in brackets.
fn unit(doc: &str) -> &str {
    let end = doc.rfind(']').unwrap_or(0);
    doc[..end].rfind('[').map_or("", |start| &doc[start + 1..end])
}

/// The tables of a list of the scene.
fn entries<'a>(scene: &'a mut Table, list: &str) -> impl Iterator<Item = &'a mut Table> {
    scene.get_mut(list).and_then(Value::as_array_mut).into_iter().flatten().filter_map(Value::as_table_mut)
}

/// A robot that comes with the program, or one with meshes, somewhere in the world: as such it is a metre high, and the world is of any size.
fn robot(frame: &mut Frame, name: &str) -> Table {
    let mut robot = Table::new();
    let model = frame.pick(&["quadruped", "humanoid", "arm", "arm-rod", "arm-shovel", "arm-scraper", "meshes"]);
    let mut set = |key: &str, value: Value| drop(robot.insert(key.to_owned(), value));
    set("name", Value::String(name.to_owned()));
    if model == "meshes" {
        set("urdf", Value::String(frame.pick(&["loader.urdf", "pail.urdf"]).to_owned()));
        let links = frame.pick(&[&["buck*"][..], &["body", "bucket"]]);
        let links = links.iter().map(|link| Value::String((*link).to_owned())).collect();
        let links = Value::Table(Table::from_iter([("exact_links".to_owned(), Value::Array(links))]));
        let meshes = ["hull", "exact"].map(|all| Value::String(all.to_owned())).into_iter().chain([links]);
        set("collision_meshes", frame.pick(&meshes.collect::<Vec<_>>()));
    } else {
        set("model", Value::String(model.to_owned()));
    }
    set("position", floats(frame.point(5.0)));
    let turn = frame.between(-0.5, 0.5);
    set("rotation", floats([turn.cos(), 0.0, 0.0, turn.sin()]));
    set("fixed", Value::Boolean(model.starts_with("arm")));
    if !model.starts_with("arm") && frame.is(0.5) {
        set("velocity", floats(frame.direction().map(|x| x * frame.speed)));
    }
    if model == "quadruped" {
        let bent = frame.between(0.6, 0.9);
        let bent = [("*_thigh_joint", bent), ("*_calf_joint", -2.0 * bent)];
        set(
            "joints",
            Value::Table(bent.map(|(joint, angle)| (joint.to_owned(), Value::Float(angle))).into_iter().collect()),
        );
    }
    if frame.is(0.2) {
        let masses = [("*".to_owned(), Value::Float(frame.between(0.1, 5.0)))];
        set("masses", Value::Table(masses.into_iter().collect()));
    }
    if frame.is(0.7) {
        let mut motor = Table::new();
        let kp = frame.pick(&[0.0, 10.0, 250.0, 2000.0]);
        motor.insert("kp".to_owned(), Value::Float(kp));
        motor.insert("kd".to_owned(), Value::Float(0.03 * kp));
        set("motor", Value::Array(vec![Value::Table(motor)]));
    }
    let motion =
        [("quadruped", "quadruped-trot"), ("humanoid", "humanoid-step")].into_iter().find(|one| one.0 == model);
    if let Some((_, motion)) = motion.filter(|_| frame.is(0.4)) {
        let motion = [("model".to_owned(), Value::String(motion.to_owned()))];
        set("motion", Value::Table(motion.into_iter().collect()));
    }
    set("self_collision", Value::Boolean(frame.is(0.3)));
    robot
}

/// A tool beside a robot, near enough to touch it: a free one, one that a force pushes, or a fixed one.
fn company(frame: &mut Frame, robot: &Table) -> Table {
    let at = robot["position"].as_array().into_iter().flatten().filter_map(Value::as_float);
    let position = at.map(|x| x + frame.between(-0.4, 0.4)).collect::<Vec<_>>();
    let half = frame.between(0.02, 0.15);
    let mass = frame.decades(0.05, 20.0);
    let (shape, motion) = match frame.below(6) {
        0 => (format!("sphere = {{ center = [0, 0, 0], radius = {half} }}"), "\"fixed\"".to_owned()),
        1 | 2 => {
            let force = 10.0 * mass;
            let motion =
                format!("{{ servo = {{ axis = [0, 0, -1], force = {force}, mass = {mass}, damping = {mass} }} }}");
            (format!("box = {{ half = [{half}, 0.1, {half}] }}"), motion)
        }
        kind => {
            let shape = match kind {
                3 => format!("sphere = {{ center = [0, 0, 0], radius = {half} }}"),
                _ => format!("box = {{ half = [{half}, 0.05, 0.1] }}"),
            };
            let linear = frame.direction().map(|x| x * frame.speed);
            let restitution = frame.pick(&[0.0, 0.0, 0.5]);
            (shape, format!("{{ free = {{ mass = {mass}, linear = {linear:?}, restitution = {restitution} }} }}"))
        }
    };
    let text = format!("name = \"beside\"\nposition = {position:?}\nshape = {{ {shape} }}\nmotion = {motion}");
    text.parse().expect("a tool's own text is TOML")
}

/// A source and a sink somewhere in the world.
fn flow(frame: &mut Frame) -> [Table; 2] {
    let cell = frame.cell;
    let ball = |at: [f64; 3], radius: f64| {
        let sphere = [("center".to_owned(), floats(at)), ("radius".to_owned(), Value::Float(radius))];
        let shape = [("sphere".to_owned(), Value::Table(sphere.into_iter().collect()))];
        Value::Table(shape.into_iter().collect())
    };
    let (mut source, mut sink) = (Table::new(), Table::new());
    source.insert("material".to_owned(), Value::String(format!("m{}", frame.below(frame.materials))));
    source.insert("shape".to_owned(), ball(frame.point(5.0), cell * frame.between(1.0, 3.0)));
    let along = frame.direction().map(|x| x * frame.speed);
    let is_still = along.iter().all(|x| *x == 0.0);
    source.insert("velocity".to_owned(), floats(if is_still { [0.0, 0.0, -frame.speed] } else { along }));
    source.insert("until".to_owned(), Value::Float(frame.decades(1e-3, 0.1)));
    source
        .insert("sampling".to_owned(), Value::String(frame.pick(&["auto", "lattice", "stagger", "jitter"]).to_owned()));
    let least = 2.0 * f64::from(1 << (frame.levels - 1));
    sink.insert("shape".to_owned(), ball(frame.point(3.0), cell * frame.between(least, least + 3.0)));
    sink.insert("from".to_owned(), Value::Float(frame.pick(&[0.0, 1e-3, 1e-2])));
    [source, sink]
}

/// A probe of some kind, of all particles or some.
fn probe(number: usize, scene: &Table, frame: &mut Frame) -> Table {
    let table = |entries: &[(&str, Value)]| -> Value {
        Value::Table(entries.iter().map(|(key, value)| ((*key).to_owned(), value.clone())).collect())
    };
    let ends = |frame: &mut Frame| {
        let (a, b) = (frame.point(2.0), frame.point(2.0));
        let min: [f64; 3] = std::array::from_fn(|d| a[d].min(b[d]));
        (min, std::array::from_fn(|d| a[d].max(b[d]).max(min[d] + frame.cell)))
    };
    let walls = below(scene, &["world", "walls"]).and_then(Value::as_table).into_iter().flatten();
    let stands = |wall: &Value| !matches!(wall.as_str(), Some("open" | "periodic"));
    let sides: Vec<&String> = walls.filter(|(_, wall)| stands(wall)).map(|(side, _)| side).collect();
    let (min, max): ([f64; 3], [f64; 3]) = ends(frame);
    let (center, radius) = (floats(frame.point(3.0)), Value::Float(frame.length(1.0, 6.0)));
    let kind = frame.pick(&["flux", "flux", "within", "surface", "wall", "nearest", "chamfer"]);
    let (kind, measured) = match kind {
        "wall" if !sides.is_empty() => {
            let side = Value::String(frame.pick(&sides).clone());
            let all = [("side", side), ("min", floats(min)), ("max", floats(max))];
            ("wall", table(if frame.is(0.5) { &all } else { &all[..1] }))
        }
        "flux" if frame.is(0.5) => {
            let axis = frame.below(3);
            let max: [f64; 3] = std::array::from_fn(|d| if d == axis { min[d] } else { max[d] });
            ("flux", table(&[("rectangle", table(&[("min", floats(min)), ("max", floats(max))]))]))
        }
        "flux" => {
            let mut normal = frame.direction();
            normal[2] += 0.01;
            ("flux", table(&[("disc", table(&[("center", center), ("normal", floats(normal)), ("radius", radius)]))]))
        }
        "surface" => {
            let (from, to) = (floats([min[0], min[1]]), floats([max[0], max[1]]));
            let (n, above) = (Value::Integer(1 + frame.below(4) as i64), Value::Float(min[2]));
            let [min, max] = [from.clone(), to.clone()];
            let points = Value::Array(vec![n.clone(), n.clone()]);
            let patch = table(&[("min", min), ("max", max), ("points", points), ("above", above)]);
            let line = table(&[("from", from.clone()), ("to", to), ("points", n)]);
            let points = Value::Array(vec![from]);
            ("surface", table(&[frame.pick(&[("patch", patch), ("line", line), ("points", points)])]))
        }
        "nearest" => ("nearest", center),
        "chamfer" => ("chamfer", Value::String(frame.pick(&["cloud.csv", "point.csv"]).to_owned())),
        _ => {
            let upright = [("center", center.clone()), ("radius", radius.clone()), ("half_height", radius.clone())];
            let regions = [
                ("box", table(&[("min", floats(min)), ("max", floats(max))])),
                ("sphere", table(&[("center", center), ("radius", radius)])),
                ("cylinder", table(&upright)),
            ];
            ("within", table(&[frame.pick(&regions)]))
        }
    };
    let mut probe = Table::new();
    probe.insert("name".to_owned(), Value::String(format!("p{number}")));
    if !matches!(kind, "surface" | "wall") {
        let level = Value::Integer(frame.below(frame.levels as usize) as i64);
        let mut own = |list: &str| {
            let all = below(scene, &[list]).and_then(Value::as_array).cloned().unwrap_or_default();
            let names: Vec<Value> = all.iter().filter_map(|entry| entry.get("name").cloned()).collect();
            (!names.is_empty()).then(|| frame.pick(&names))
        };
        let (material, body) = (own("material"), own("body"));
        for (key, value) in [("level", Some(level)), ("material", material), ("body", body)] {
            value.filter(|_| frame.is(0.2)).map(|value| probe.insert(key.to_owned(), value));
        }
    }
    if frame.is(0.5) {
        probe.insert("interval".to_owned(), Value::Float(frame.decades(1e-4, 0.1)));
    }
    probe.insert(kind.to_owned(), measured);
    probe
}

/// Mends what declarations do not say: what refers to each other, and what excludes each other.
fn mend(scene: &mut Table, frame: &mut Frame) {
    mend_walls(scene, frame);
    for body in entries(scene, "body") {
        mend_heights(body, frame, false);
        mend_zones(body);
    }
    for tool in entries(scene, "tool") {
        mend_heights(tool, frame, true);
        mend_path(tool, frame);
        // What has no mass does not move freely.
        let heavy = !["plane", "height_field", "terrain"].iter().any(|shape| tool["shape"].to_string().contains(shape));
        if !heavy && below(tool, &["motion", "free"]).is_some() {
            tool.remove("motion");
        }
    }
    mend_levels(scene, frame);
    mend_rest(scene);
    // From the top there is no camera.
    let top = below(scene, &["output", "picture", "view"]).is_some_and(|view| view.as_str() == Some("top"));
    let picture = within(scene, "output").and_then(|output| within(output, "picture"));
    if let Some(picture) = picture.filter(|_| top) {
        picture.remove("camera");
    }
}

/// A value below some keys.
fn below<'a>(table: &'a Table, keys: &[&str]) -> Option<&'a Value> {
    let (first, rest) = keys.split_first()?;
    rest.iter().try_fold(table.get(*first)?, |value, key| value.get(key))
}

/// A table below a key of another.
fn within<'a>(table: &'a mut Table, key: &str) -> Option<&'a mut Table> {
    table.get_mut(key).and_then(Value::as_table_mut)
}

/// A periodic side has another across; an open one may lie anywhere.
fn mend_walls(scene: &mut Table, frame: &mut Frame) {
    let Some(world) = within(scene, "world") else { return };
    let word = |world: &Table, side: &str| below(world, &["walls", side]).cloned();
    let mut ends = ["min", "max"].map(|end| world[end].as_array().cloned().unwrap_or_default());
    for (d, axis) in ["x", "y", "z"].into_iter().enumerate() {
        let sides = ["min", "max"].map(|side| format!("{axis}_{side}"));
        let periodic = sides.each_ref().map(|side| word(world, side).is_some_and(|w| w.as_str() == Some("periodic")));
        if let (Some(walls), true) = (within(world, "walls"), periodic[0] != periodic[1]) {
            sides.iter().for_each(|side| drop(walls.insert(side.clone(), Value::String("periodic".to_owned()))));
        }
        for (side, end) in sides.iter().zip(&mut ends) {
            let is_open = word(world, side).is_none_or(|w| w.as_str() == Some("open"));
            let joined = periodic[0] || periodic[1];
            if let (Some(Value::Float(x)), true) = (end.get_mut(d), is_open && !joined && frame.is(0.2)) {
                let outwards = if side.ends_with("min") { -1.0 } else { 1.0 };
                *x += outwards * frame.cell * frame.uniform();
            }
        }
    }
    let [min, max] = ends;
    world.insert("min".to_owned(), Value::Array(min));
    world.insert("max".to_owned(), Value::Array(max));
}

/// Has a shape a surface above each of its points?
fn is_layer(shape: Option<&Value>) -> bool {
    ["box", "height_field", "terrain"].iter().any(|layer| shape.is_some_and(|shape| shape.get(layer).is_some()))
}

/// A zone is somewhere, and a body with zones does not turn.
fn mend_zones(body: &mut Table) {
    let layered = is_layer(body.get("shape"));
    let Some(zones) = body.get_mut("zone").and_then(Value::as_array_mut) else { return };
    for zone in zones.iter_mut().filter_map(Value::as_table_mut) {
        if !layered {
            zone.remove("below");
        }
        for place in ["within", "picture"] {
            let Some(place) = within(zone, place) else { continue };
            let ends = ["min", "max"].map(|end| place[end].as_array().cloned().unwrap_or_default());
            let pairs = ends[0].iter().zip(&ends[1]).filter_map(|(a, b)| Some((a.as_float()?, b.as_float()?)));
            let (min, max): (Vec<f64>, Vec<f64>) = pairs.map(|(a, b)| (a.min(b), a.max(b))).unzip();
            place.insert("min".to_owned(), floats(min));
            place.insert("max".to_owned(), floats(max));
        }
    }
    zones.retain(|zone| ["below", "within", "picture"].iter().any(|place| zone.get(place).is_some()));
    if zones.is_empty() {
        body.remove("zone");
    } else {
        body.remove("angular_velocity");
    }
}

/// A terrain has room above its lower end, and its dunes are not too steep.
fn mend_terrain(ground: &mut Table, [origin, span]: [[f64; 3]; 2], scale: f64) {
    ground.insert("min".to_owned(), floats([origin[0], origin[1]]));
    ground.insert("max".to_owned(), floats([origin[0] + span[0], origin[1] + span[1]]));
    ground.insert("bottom".to_owned(), Value::Float(origin[2]));
    let middle: [f64; 3] = std::array::from_fn(|d| origin[d] + 0.5 * span[d]);
    ground.insert("origin".to_owned(), floats([middle[0], middle[1], origin[2] + scale]));
    let dunes = within(ground, "surface").and_then(|surface| within(surface, "dunes"));
    if let Some(dunes) = dunes {
        let wavelength = dunes["wavelength"].as_float().unwrap_or(1.0);
        let height = dunes["height"].as_float().unwrap_or(1.0);
        dunes.insert("height".to_owned(), Value::Float(height.min(0.05 * wavelength)));
    }
}

/// A height field and a terrain lie on the world's floor, or about a tool's origin; a height field has its heights from one place.
fn mend_heights(of: &mut Table, frame: &mut Frame, of_tool: bool) {
    let Some(shape) = within(of, "shape") else { return };
    entries(shape, "union").for_each(|part| mend_heights(part, frame, of_tool));
    let (cell, first) = (frame.cell, frame.first.map(|c| c as f64));
    let (origin, span, scale) = if of_tool {
        ([-2.0 * cell; 3], [4.0 * cell; 2], cell)
    } else {
        (first.map(|c| c * cell), [0, 1].map(|d| frame.cells[d] as f64 * cell), 4.0 * cell)
    };
    if let Some(ground) = within(shape, "terrain") {
        mend_terrain(ground, [origin, [span[0], span[1], 0.0]], scale);
    }
    let Some(field) = within(shape, "height_field") else { return };
    field.insert("min".to_owned(), floats([origin[0], origin[1]]));
    field.insert("max".to_owned(), floats([origin[0] + span[0], origin[1] + span[1]]));
    field.insert("bottom".to_owned(), Value::Float(origin[2]));
    if frame.is(0.2) {
        field.insert("file".to_owned(), Value::String("heights.csv".to_owned()));
        field.remove("heights");
    } else {
        field.remove("file");
        let mut row = || floats((0..3).map(|_| origin[2] + scale * frame.between(0.2, 1.0)).collect::<Vec<_>>());
        field.insert("heights".to_owned(), Value::Array(vec![row(), row()]));
    }
}

/// A path begins where its tool is, and goes on at a speed that others have too.
fn mend_path(tool: &mut Table, frame: &mut Frame) {
    let at: Vec<f64> =
        tool.get("position").and_then(Value::as_array).into_iter().flatten().filter_map(Value::as_float).collect();
    let Some(path) = within(tool, "motion").and_then(|motion| within(motion, "keyframes")) else { return };
    let mut time = 0.0;
    let mut at = at;
    for keyframe in entries(path, "frames") {
        keyframe.insert("time".to_owned(), Value::Float(time));
        keyframe.insert("position".to_owned(), floats(at.clone()));
        let span = frame.cell / frame.speed * frame.decades(0.1, 10.0);
        let way = frame.direction().map(|x| x * frame.speed * span);
        time += span;
        at.iter_mut().zip(way).for_each(|(x, way)| *x += way);
    }
}

/// What levels follow, by its name or with boxes of its own.
fn agent(name: Value, frame: &mut Frame) -> Value {
    if frame.is(0.5) {
        return name;
    }
    let mut table = Table::new();
    table.insert("name".to_owned(), name);
    if frame.is(0.5) {
        table.insert("half".to_owned(), Value::Integer(frame.pick(&[8, 8, 10, 12, 16])));
    }
    if frame.is(0.5) {
        let cells = frame.decades(0.1, 10.0);
        table.insert("offset".to_owned(), floats(frame.direction().map(|x| x * cells * frame.cell)));
    }
    // No tool and no body has a link.
    let at = if frame.is(0.01) { "tip" } else { frame.pick(&["origin", "lowest"]) };
    if frame.is(0.5) {
        table.insert("at".to_owned(), Value::String(at.to_owned()));
    }
    Value::Table(table)
}

/// Levels follow what there is, and what does not go with them is left out.
fn mend_levels(scene: &mut Table, frame: &mut Frame) {
    let lets_go = |scene: &Table| {
        let walls = below(scene, &["world", "walls"]).and_then(Value::as_table);
        walls.into_iter().flatten().any(|(_, wall)| wall.is_table())
    };
    let lets_go = lets_go(scene);
    let mut names =
        |list: &str| -> Vec<Value> { entries(scene, list).filter_map(|entry| entry.get("name").cloned()).collect() };
    let (bodies, tools) = (names("body"), names("tool"));
    let Some(levels) = within(scene, "levels") else { return };
    if lets_go {
        levels.remove("subcycle");
    }
    if let Some(agents) = levels.get_mut("agents").and_then(Value::as_array_mut) {
        agents.retain(|agent| {
            let name = agent.get("name").unwrap_or(agent);
            bodies.contains(name) || tools.contains(name)
        });
    }
    if levels.get("reach").and_then(Value::as_integer).unwrap_or(0) == 0 {
        return;
    }
    // Ground that comes within reach is at rest, and follows tools.
    if frame.levels == 1 || tools.is_empty() {
        levels.remove("reach");
        return;
    }
    levels.insert("agents".to_owned(), Value::Array(tools[..1].to_vec()));
    scene.remove("gravity_ramp");
    let weight = floats([0.0, 0.0, -9.81]);
    scene.insert("gravity".to_owned(), weight);
    if let Some(walls) = within(scene, "world").and_then(|world| within(world, "walls")) {
        walls.retain(|_, wall| wall.as_str() != Some("periodic"));
    }
    if let Some(bodies) = scene.get_mut("body").and_then(Value::as_array_mut) {
        bodies.retain(|body| is_layer(body.get("shape")));
    }
    for body in entries(scene, "body") {
        body.insert("settled".to_owned(), Value::Boolean(true));
    }
}

/// Ground that starts settled, and ground that sleeps, asks for other things too.
fn mend_rest(scene: &mut Table) {
    let gravity: Vec<f64> = below(scene, &["gravity"])
        .and_then(Value::as_array)
        .into_iter()
        .flatten()
        .filter_map(Value::as_float)
        .collect();
    let down = gravity.is_empty() || (gravity[..2] == [0.0; 2] && gravity[2] <= 0.0);
    let ramp = scene.contains_key("gravity_ramp");
    for body in entries(scene, "body") {
        let layered = is_layer(body.get("shape"));
        if body.get("settled").and_then(Value::as_bool) == Some(true) {
            if down && !ramp && layered {
                body.remove("velocity");
                body.remove("angular_velocity");
            } else {
                body.remove("settled");
            }
        }
    }
    let walls = below(scene, &["world", "walls"]).and_then(Value::as_table);
    let lets_go = walls.into_iter().flatten().any(|(_, wall)| wall.is_table());
    let weightless = gravity == [0.0; 3];
    if let Some(sleep) = within(scene, "sleep")
        && (lets_go || (weightless && !sleep.contains_key("speed")))
    {
        sleep.remove("on");
    }
}
