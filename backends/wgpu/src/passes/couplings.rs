//! The laws of all couplings of a world as one text.

use crate::passes::wgsl_words::{declared_names, renamed};
use barchan_core::Coupling;
use barchan_core::contact;
use barchan_core::coupling::{DeviceGroup, DeviceLaw, Group};
use std::fmt::Write as _;

/// A function of a coupling that passes call.
pub(crate) struct Function {
    pub(crate) name: &'static str,
    /// Behind the number of the body or the group: names and types.
    pub(crate) arguments: &'static [(&'static str, &'static str)],
    /// Nothing, if it is empty.
    pub(crate) returns: &'static str,
    /// What it returns where a text lacks it.
    stand_in: &'static str,
}

pub(crate) const FUNCTIONS: [Function; 6] = [
    Function {
        name: "coupling_field",
        arguments: &[("x", "vec3<f32>"), ("u", "vec3<f32>"), ("mass", "f32"), ("dt", "f32")],
        returns: "vec3<f32>",
        stand_in: "u",
    },
    Function {
        name: "coupling_distance",
        arguments: &[("x", "vec3<f32>"), ("cell", "f32")],
        returns: "f32",
        stand_in: "1e30",
    },
    Function {
        name: "coupling_press",
        arguments: &[("x", "vec3<f32>"), ("half", "f32"), ("modulus", "f32"), ("cell", "f32")],
        returns: "vec3<f32>",
        stand_in: "vec3<f32>(0.0)",
    },
    Function {
        name: "coupling_grip",
        arguments: &[("x", "vec3<f32>"), ("cell", "f32"), ("press", "vec3<f32>")],
        returns: "CouplingGrip",
        stand_in: "CouplingGrip(GRIP_NONE, vec3<f32>(0.0), 0.0, false, 1e30)",
    },
    Function { name: "coupling_friction", arguments: &[], returns: "f32", stand_in: "0.0" },
    Function {
        name: "coupling_box",
        arguments: &[("rows", "array<vec3<f32>, 3>"), ("cell", "f32")],
        returns: "array<vec3<f32>, 2>",
        stand_in: "array<vec3<f32>, 2>(vec3<f32>(1e30), vec3<f32>(-1e30))",
    },
];

/// Those of groups that answer; see [`DeviceAnswer`](barchan_core::coupling::DeviceAnswer).
pub(crate) const OF_GROUPS: [Function; 6] = [
    of_group("coupling_begin", &[THREAD], ""),
    of_group("coupling_answer", &[THREAD], ""),
    of_group("coupling_balance", &[("along", "u32"), THREAD], "f32"),
    of_group("coupling_twice_energy", &[("which", "u32"), THREAD], "f32"),
    of_group("coupling_feel", &[THREAD], ""),
    of_group("coupling_advance", &[THREAD], ""),
];
const THREAD: (&str, &str) = ("thread", "u32");

const fn of_group(
    name: &'static str,
    arguments: &'static [(&'static str, &'static str)],
    returns: &'static str,
) -> Function {
    Function { name, arguments, returns, stand_in: if returns.is_empty() { "" } else { "0.0" } }
}

impl Function {
    /// `first` is what it is asked of, a body or a group.
    pub(crate) fn head(&self, first: &str) -> String {
        let arguments: String = self.arguments.iter().map(|(name, ty)| format!(", {name}: {ty}")).collect();
        let returns = if self.returns.is_empty() { String::new() } else { format!(" -> {}", self.returns) };
        format!("fn {}({first}: u32{arguments}){returns}", self.name)
    }
}

/// What the couplings of a world are for the device, as if they were one. Fields have the lowest numbers of bodies, then come the others' in the scene's
/// order.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Laws {
    /// Are all loops of the texts counted?
    pub(crate) counted: bool,
    pub(crate) wgsl: String,
    /// How groups answer, for the pass in which they do so, besides.
    pub(crate) answer: String,
    /// How far beyond the box of a body that answers it acts on nodes [cells of their level].
    pub(crate) reach: f64,
    pub(crate) table: Vec<[f32; 4]>,
    pub(crate) samples: Vec<[f32; 4]>,
    /// The groups that answer, in the couplings' order, and how far beyond their boxes each coupling itself acts [cells].
    pub(crate) groups: Vec<Vec<DeviceGroup>>,
    reaches: Vec<f64>,
    /// The number of each coupling's first body, in the couplings' order.
    pub(crate) firsts: Vec<usize>,
    /// Bodies of all couplings.
    pub(crate) bodies: usize,
}

impl Laws {
    /// `None` if there is no coupling, or the law of one does not run on devices.
    pub(crate) fn of(couplings: &[Box<dyn Coupling>]) -> Option<Self> {
        let own: Vec<DeviceLaw> = couplings.iter().map(|coupling| coupling.device_law()).collect::<Option<_>>()?;
        let counts: Vec<usize> = couplings.iter().map(|coupling| coupling.bounds().len()).collect();
        let fits = couplings.iter().zip(&counts).all(|(coupling, count)| *count == coupling.wrenches().len());
        // A coupling that says nothing of its groups for devices keeps them to itself.
        let answers =
            couplings.iter().zip(&own).all(|(coupling, law)| are_same(&coupling.device_groups(), &law.answer.groups));
        let bodies = counts.iter().sum();
        if !fits || !answers || bodies == 0 {
            return None;
        }
        let (fields, others): (Vec<_>, Vec<_>) = (0..couplings.len()).partition(|&c| couplings[c].is_field());
        let (mut firsts, mut next) = (vec![0; couplings.len()], 0);
        let order: Vec<usize> = fields.iter().chain(&others).copied().collect();
        for &c in &order {
            firsts[c] = next;
            next += counts[c];
        }
        let of_fields = fields.iter().map(|&c| counts[c]).sum::<usize>();
        let is_field = format!("fn is_field(body: u32) -> bool {{ return body < {of_fields}u; }}\n");
        let is_alone = own.len() == 1;
        let (table, samples) =
            if is_alone { (own[0].table.clone(), own[0].samples.clone()) } else { tables(&own, &order, &firsts) };
        let [text, answer] = if is_alone { alone(&own[0]) } else { together(&own, &order) };
        let answering = own.iter().filter(|law| !law.answer.groups.is_empty());
        Some(Self {
            counted: own.iter().all(|law| law.counted),
            wgsl: [contact::wgsl::CONTACT_LAW, &is_field, &text].concat(),
            answer,
            reach: answering.map(|law| law.reach).fold(0.0, f64::max),
            table,
            samples,
            reaches: own.iter().map(|law| law.reach).collect(),
            groups: own.into_iter().map(|law| law.answer.groups).collect(),
            firsts,
            bodies,
        })
    }

    /// The groups, where bodies of all couplings are looked for as far as those that act furthest do, on finest cells of width `h` [m].
    pub(crate) fn groups(&self, h: f64) -> Vec<Vec<DeviceGroup>> {
        let mut groups = self.groups.clone();
        for (groups, reach) in groups.iter_mut().zip(&self.reaches) {
            let bodies = groups.iter_mut().flat_map(|group| &mut group.bodies);
            bodies.for_each(|body| body.reach += (self.reach - reach).max(0.0) * h);
        }
        groups
    }

    /// The text of no coupling at all.
    pub(crate) fn none() -> Self {
        let is_field = "fn is_field(body: u32) -> bool { return false; }\n";
        let [text, answer] = alone(&DeviceLaw::default());
        let wgsl = [contact::wgsl::CONTACT_LAW, is_field, &text].concat();
        Self { counted: true, wgsl, answer, ..Self::default() }
    }
}

/// Does a coupling say for devices what groups it has?
fn are_same(groups: &[Group], on_device: &[DeviceGroup]) -> bool {
    groups.len() == on_device.len()
        && groups.iter().zip(on_device).all(|(group, one)| group.bodies.len() == one.bodies.len())
}

/// A text, and what it lacks of the functions that passes call.
fn with_all(wgsl: &str, functions: &[Function], first: &str) -> String {
    let names = declared_names(wgsl);
    let missing = functions.iter().filter(|function| !names.iter().any(|name| name == function.name));
    let stand_in = |function: &Function| match function.stand_in {
        "" => format!("{} {{}}\n", function.head(first)),
        value => format!("{} {{ return {value}; }}\n", function.head(first)),
    };
    wgsl.to_owned() + "\n" + &missing.map(stand_in).collect::<String>()
}

/// How a coupling grips, and how its groups answer: with all functions that passes call.
fn texts_of(law: &DeviceLaw) -> [String; 2] {
    [with_all(&law.wgsl, &FUNCTIONS, "body"), with_all(&law.answer.wgsl, &OF_GROUPS, "group")]
}

/// The same, with names of its own for all else that it declares, which may be a pass's, too.
fn alone(law: &DeviceLaw) -> [String; 2] {
    let texts = texts_of(law);
    let names: Vec<String> = texts.iter().flat_map(|text| declared_names(text)).collect();
    let is_called = |word: &str| FUNCTIONS.iter().chain(&OF_GROUPS).any(|function| function.name == word);
    let own = |word: &str| (!is_called(word) && names.iter().any(|name| name == word)).then(|| format!("{word}_own"));
    let [wgsl, answer] = texts.map(|text| renamed(&text, own));
    let answer =
        answer + "fn number_in_coupling(body: u32) -> u32 { return body; }\nfn take_up_group(thread: u32) {}\n";
    [wgsl, answer]
}

/// Tables behind one another, and before them, for each coupling, its first body, and where its table and its samples begin.
fn tables(own: &[DeviceLaw], order: &[usize], firsts: &[usize]) -> (Vec<[f32; 4]>, Vec<[f32; 4]>) {
    let (mut heads, mut table, mut samples) = (Vec::new(), Vec::<[f32; 4]>::new(), Vec::new());
    for &c in order {
        heads.push([firsts[c] as f32, (own.len() + table.len()) as f32, samples.len() as f32, 0.0]);
        table.extend(&own[c].table);
        samples.extend(&own[c].samples);
    }
    heads.extend(table);
    (heads, samples)
}

/// The texts of several couplings side by side, each once and under names of its own, and functions that pick among them by the number of a body, or by the
/// coupling of the group at hand.
fn together(own: &[DeviceLaw], order: &[usize]) -> [String; 2] {
    let mut texts: Vec<[String; 2]> = Vec::new();
    let mut text_of = Vec::new();
    for &c in order {
        let both = texts_of(&own[c]);
        text_of.push(texts.iter().position(|text| *text == both).unwrap_or(texts.len()));
        if text_of.last() == Some(&texts.len()) {
            texts.push(both);
        }
    }
    let sampled = own.iter().any(|law| !law.samples.is_empty());
    let mut all = format!(
        "// The coupling at hand: where its table and its samples begin, and its first body.\n\
         var<private> first_vector: u32;\nvar<private> first_sample: u32;\nvar<private> first_body: u32;\n\
         fn table_of_coupling(i: u32) -> vec4<f32> {{ return coupling_table(first_vector + i); }}\n\
         fn take_up_coupling(body: u32) -> u32 {{\n\
         var c = 0u;\n\
         for (var k = 1u; k < {count}u; k++) {{ if f32(body) >= coupling_table(k).x {{ c = k; }} }}\n\
         let head = coupling_table(c);\n\
         first_body = u32(head.x);\nfirst_vector = u32(head.y);\nfirst_sample = u32(head.z);\n\
         return c;\n}}\n",
        count = order.len(),
    );
    let sample = if sampled { "coupling_sample(first_sample + i)" } else { "vec4<f32>(0.0)" };
    let _ = writeln!(all, "fn sample_of_coupling(i: u32) -> vec4<f32> {{ return {sample}; }}");
    // All threads are to know it, so that they go the same way.
    let mut answer = "var<workgroup> coupling_of_group: u32;\n\
         fn number_in_coupling(body: u32) -> u32 { return body - first_body; }\n\
         fn take_up_group(thread: u32) {\n\
         let c = take_up_coupling(number_of(0u));\n\
         if thread == 0u { coupling_of_group = c; }\n\
         workgroupBarrier();\n}\n"
        .to_owned();
    for (t, text) in texts.iter().enumerate() {
        let names: Vec<String> = text.iter().flat_map(|text| declared_names(text)).collect();
        let [grips, answers] = text.each_ref().map(|text| {
            renamed(text, |word| match word {
                "coupling_table" => Some("table_of_coupling".to_owned()),
                "coupling_sample" => Some("sample_of_coupling".to_owned()),
                _ => names.iter().any(|name| name == word).then(|| format!("{word}_of_{t}")),
            })
        });
        all += &grips;
        answer += &answers;
    }
    let pick = |function: &Function, first: [&str; 2], chosen: &str| {
        let arguments: String = function.arguments.iter().map(|(name, _)| format!(", {name}")).collect();
        let (last, before) = text_of.split_last().map_or((&0, &[][..]), |pair| pair);
        let returns = if function.returns.is_empty() { "" } else { "return " };
        let call = |t: &usize| format!("{{ {returns}{}_of_{t}({}{arguments}); }}\n", function.name, first[1]);
        let cases: String = before.iter().enumerate().map(|(c, t)| format!("case {c}u: {}", call(t))).collect();
        let head = function.head(first[0]);
        format!("{head} {{\n{chosen} {{\n{cases}default: {}}}\n}}\n", call(last))
    };
    for function in &FUNCTIONS {
        all += &pick(function, ["body", "body - first_body"], "switch take_up_coupling(body)");
    }
    let chosen = "let c = take_up_coupling(number_of(0u));\nswitch coupling_of_group";
    for function in &OF_GROUPS {
        answer += &pick(function, ["group", "group"], &chosen.replace("let c", "_"));
    }
    [all, answer]
}
