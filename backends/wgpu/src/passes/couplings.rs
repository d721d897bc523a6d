//! The laws of all couplings of a world as one text.

use crate::passes::wgsl_words::{declared_names, renamed};
use barchan_core::Coupling;
use barchan_core::coupling::DeviceLaw;
use std::fmt::Write as _;

/// A function of a coupling that passes call.
struct Function {
    name: &'static str,
    /// Behind the number of the body: names and types.
    arguments: &'static [(&'static str, &'static str)],
    returns: &'static str,
    /// What it returns where a text lacks it.
    stand_in: &'static str,
}

const FUNCTIONS: [Function; 6] = [
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

impl Function {
    fn head(&self) -> String {
        let arguments: String = self.arguments.iter().map(|(name, ty)| format!(", {name}: {ty}")).collect();
        format!("fn {}(body: u32{arguments}) -> {}", self.name, self.returns)
    }
}

/// What the couplings of a world are for the device, as if they were one. Fields have the lowest numbers of bodies, then come the others' in the scene's
/// order.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Laws {
    /// Are all loops of the text counted?
    pub(crate) counted: bool,
    pub(crate) wgsl: String,
    /// How far beyond a free body's box it acts on nodes [cells of their level].
    pub(crate) reach: f64,
    pub(crate) table: Vec<[f32; 4]>,
    pub(crate) samples: Vec<[f32; 4]>,
    /// The free bodies' extents [m].
    pub(crate) free: Vec<f64>,
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
        let bodies = counts.iter().sum();
        if !fits || bodies == 0 {
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
        let alone = own.len() == 1;
        let (table, samples) =
            if alone { (own[0].table.clone(), own[0].samples.clone()) } else { tables(&own, &order, &firsts) };
        let text = if alone { with_all(&own[0].wgsl) } else { together(&own, &order) };
        Some(Self {
            counted: own.iter().all(|law| law.counted),
            wgsl: [include_str!("../wgsl/contact_law.wgsl"), &is_field, &text].concat(),
            reach: own.iter().filter(|law| !law.free.is_empty()).map(|law| law.reach).fold(0.0, f64::max),
            table,
            samples,
            free: others.iter().flat_map(|&c| own[c].free.clone()).collect(),
            firsts,
            bodies,
        })
    }

    /// The text of no coupling at all.
    pub(crate) fn none() -> Self {
        let is_field = "fn is_field(body: u32) -> bool { return false; }\n";
        let wgsl = [include_str!("../wgsl/contact_law.wgsl"), is_field, &with_all("")].concat();
        Self { counted: true, wgsl, ..Self::default() }
    }
}

/// A text, and what it lacks of the functions that passes call.
fn with_all(wgsl: &str) -> String {
    let names = declared_names(wgsl);
    let missing = FUNCTIONS.iter().filter(|function| !names.iter().any(|name| name == function.name));
    let stand_in = |function: &Function| format!("{} {{ return {}; }}\n", function.head(), function.stand_in);
    wgsl.to_owned() + "\n" + &missing.map(stand_in).collect::<String>()
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

/// The texts of several couplings side by side, each once and under names of its own, and functions that pick among them by the number of a body.
fn together(own: &[DeviceLaw], order: &[usize]) -> String {
    let mut texts: Vec<&str> = Vec::new();
    let mut text_of = Vec::new();
    for &c in order {
        let wgsl = own[c].wgsl.as_str();
        text_of.push(texts.iter().position(|text| *text == wgsl).unwrap_or(texts.len()));
        if text_of.last() == Some(&texts.len()) {
            texts.push(wgsl);
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
    for (t, text) in texts.iter().enumerate() {
        let text = with_all(text);
        let names = declared_names(&text);
        all += &renamed(&text, |word| match word {
            "coupling_table" => Some("table_of_coupling".to_owned()),
            "coupling_sample" => Some("sample_of_coupling".to_owned()),
            _ => names.iter().any(|name| name == word).then(|| format!("{word}_of_{t}")),
        });
    }
    for function in FUNCTIONS {
        let arguments: String = function.arguments.iter().map(|(name, _)| format!(", {name}")).collect();
        let (last, before) = text_of.split_last().map_or((&0, &[][..]), |pair| pair);
        let call = |t: &usize| format!("{{ return {}_of_{t}(body - first_body{arguments}); }}\n", function.name);
        let cases: String = before.iter().enumerate().map(|(c, t)| format!("case {c}u: {}", call(t))).collect();
        let _ = write!(
            all,
            "{} {{\nswitch take_up_coupling(body) {{\n{cases}default: {}}}\n}}\n",
            function.head(),
            call(last)
        );
    }
    all
}
