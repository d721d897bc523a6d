//! A coupling's WGSL alone, so that an error names the coupling and its own line, and not a pass.

use crate::passes::couplings::{FUNCTIONS, Function, OF_GROUPS};
use crate::passes::wgsl_words::{declared_names, words_at_module_scope};
use barchan_core::contact;
use barchan_core::coupling::DeviceLaw;
use barchan_core::{Coupling, Error, Result};
use naga::AddressSpace;
use naga::proc::Layouter;
use naga::valid::{Capabilities, ValidationFlags, Validator};
use std::error::Error as _;
use std::fmt::Write as _;

const GRIP: &str = contact::wgsl::CONTACT_LAW;
const GROUP: [&str; 3] =
    [include_str!("../wgsl/group.wgsl"), include_str!("../wgsl/answering.wgsl"), contact::wgsl::SEARCH];

/// What any coupling may read.
const TABLE: &str = "
fn coupling_table(i: u32) -> vec4<f32> { var one = vec4<f32>(f32(i)); return one; }
fn coupling_sample(i: u32) -> vec4<f32> { var one = vec4<f32>(f32(i)); return one; }
";

/// What the functions of groups may use of the pass in which they answer; [`DeviceAnswer`](barchan_core::coupling::DeviceAnswer) says what it is.
const STRUCTURES: [&str; 4] = ["CouplingTwist", "CouplingPose", "CouplingSystem", "CouplingRow"];
const CONSTANTS: [&str; 6] = ["TWIST_FREE", "TWIST_EXPECTED", "TWIST_TRIED", "TWIST_STEP", "TWIST_LAST", "GROUP_ROOM"];
const FUNCTIONS_OF_PASS: [&str; 32] = [
    "search_from",
    "search_on",
    "search_part",
    "group_room",
    "set_group_room",
    "group_moves",
    "group_dt",
    "group_cell",
    "group_bodies",
    "group_body",
    "group_told",
    "group_missed",
    "group_word",
    "set_group_word",
    "group_gravity",
    "group_twist",
    "set_group_twist",
    "group_rate",
    "set_group_rate",
    "group_touches",
    "group_impulse",
    "group_impulse_before",
    "group_pose",
    "set_group_pose",
    "group_system",
    "pose_rotation",
    "pose_turned",
    "pose_shifted",
    "pose_after",
    "turning",
    "rows_of",
    "solve_rows",
];

/// Checks a coupling's WGSL alone, with stand-ins for what the backend adds: it parses, is valid without any optional capability of a device, and has what the coupling
/// needs of functions, each of the right type.
///
/// # Errors
/// [`Error::Body`] naming the coupling, and the line.
pub(crate) fn check(coupling: &dyn Coupling) -> Result<()> {
    let Some(law) = coupling.device_law() else { return Ok(()) };
    check_law(&law, coupling.is_field()).map_err(|Refusal { what, mend }| Error::Body {
        path: format!("coupling '{}'", coupling.name()),
        what,
        mend,
    })
}

#[derive(Debug)]
struct Refusal {
    what: String,
    mend: String,
}

/// Functions that a law must have.
fn wanted(law: &DeviceLaw, is_field: bool) -> Vec<&'static str> {
    if is_field {
        return vec!["coupling_field"];
    }
    let mut all = vec!["coupling_distance", "coupling_grip", "coupling_friction"];
    all.extend((law.reach > 0.0).then_some("coupling_press"));
    if !law.answer.groups.is_empty() {
        all.push("coupling_box");
        all.extend(OF_GROUPS.iter().map(|function| function.name));
    }
    all
}

fn check_law(law: &DeviceLaw, is_field: bool) -> Result<(), Refusal> {
    let texts = [("WGSL", &law.wgsl), ("WGSL of the answer", &law.answer.wgsl)];
    for (name, text) in texts {
        let foreign = ["override", "enable", "requires", "diagnostic", "compute", "vertex", "fragment", "binding"];
        if let Some((line, word)) = words_at_module_scope(text).find(|(_, word)| foreign.contains(&word.as_str())) {
            return Err(Refusal {
                what: format!("{name} line {line}: '{word}' at module scope"),
                mend: "leave it out: passes, and what they bind, are the backend's".to_owned(),
            });
        }
    }
    let names: Vec<String> = texts.iter().flat_map(|(_, text)| declared_names(text)).collect();
    let functions = || FUNCTIONS.iter().map(|one| (one, "body")).chain(OF_GROUPS.iter().map(|one| (one, "group")));
    let is_declared = |name: &str| names.iter().any(|own| own == name);
    if let Some(wanted) = wanted(law, is_field).into_iter().find(|name| !is_declared(name)) {
        let head = functions().find(|(one, _)| one.name == wanted).map(|(one, first)| one.head(first));
        return Err(Refusal {
            what: format!("its WGSL has no function {wanted}"),
            mend: format!("define {}", head.unwrap_or_default()),
        });
    }
    // Names that the text has for itself are its own in a pass, too.
    let before = [GRIP, TABLE, &stand_ins(&names)].concat();
    let calls: Vec<_> = functions().filter(|(one, _)| is_declared(one.name)).collect();
    let all = calls.iter().fold(format!("{before}{}\n{}\n", law.wgsl, law.answer.wgsl), |mut all, (one, first)| {
        let _ = writeln!(all, "{}", call(one, first));
        all
    });
    let mut firsts = vec![before.lines().count()];
    texts.iter().for_each(|(_, text)| firsts.push(firsts[firsts.len() - 1] + text.split('\n').count()));
    let refuse = |what: String, line: Option<usize>| {
        let mend = "correct it; the docs of DeviceLaw and DeviceAnswer say what may be used".to_owned();
        let Some(line) = line.filter(|line| *line > firsts[0]) else { return Refusal { what, mend } };
        if let Some((one, first)) = line.checked_sub(firsts[2] + 1).and_then(|call| calls.get(call)) {
            return Refusal {
                what: format!("{} has other arguments or another result than it must", one.name),
                mend: format!("define {}", one.head(first)),
            };
        }
        let text = usize::from(line > firsts[1]);
        Refusal { what: format!("{} line {}: {what}", texts[text].0, line - firsts[text]), mend }
    };
    let module = naga::front::wgsl::parse_str(&all)
        .map_err(|error| refuse(error.message().to_owned(), error.location(&all).map(|at| at.line_number as usize)))?;
    let mut validator = Validator::new(ValidationFlags::all(), Capabilities::empty());
    validator.validate(&module).map_err(|error| {
        let mut what = error.as_inner().to_string();
        let mut cause = error.as_inner().source();
        while let Some(deeper) = cause {
            let _ = write!(what, ": {deeper}");
            cause = deeper.source();
        }
        refuse(what, error.location(&all).map(|at| at.line_number as usize))
    })?;
    Ok(())
}

/// A function that calls one as passes do.
fn call(function: &Function, first: &str) -> String {
    let arguments: String = function.arguments.iter().map(|(name, _)| format!(", {name}")).collect();
    let name = function.name;
    let head = function.head(first).replacen(name, &format!("call_of_{name}"), 1);
    let returns = if function.returns.is_empty() { "" } else { "return " };
    format!("{head} {{ {returns}{name}({first}{arguments}); }}")
}

/// What functions of groups may use, with the types that it has in their pass, and no more of it than that; without what a text declares by itself.
fn stand_ins(own: &[String]) -> String {
    let of = |start: &str, end: &str| {
        let from = GROUP.iter().find_map(|text| Some((text, text.find(start)?)));
        from.and_then(|(text, at)| text[at..].find(end).map(|length| &text[at..at + length]))
    };
    let is_free = |name: &&&str| !own.iter().any(|own| own == *name);
    let mut all = String::new();
    for name in STRUCTURES.iter().filter(is_free) {
        let _ = writeln!(all, "{}}}", of(&format!("struct {name} {{"), "}").unwrap_or_default());
    }
    for name in CONSTANTS.iter().filter(is_free) {
        let _ = writeln!(all, "{}", of(&format!("const {name}:"), "\n").unwrap_or_default());
    }
    for name in FUNCTIONS_OF_PASS.iter().filter(is_free) {
        let head = of(&format!("fn {name}("), " {\n").unwrap_or_default();
        let body = head.split_once(" -> ").map_or(String::new(), |(_, ty)| format!("return {ty}();"));
        let _ = writeln!(all, "{head} {{ {body} }}");
    }
    all
}

/// Bytes that the variables of a pass take of an adapter's memory for workgroups; `None` if its text cannot be read.
pub(crate) fn workgroup_bytes(wgsl: &str) -> Option<u64> {
    let module = naga::front::wgsl::parse_str(wgsl).ok()?;
    let mut layouter = Layouter::default();
    layouter.update(module.to_ctx()).ok()?;
    let of_workgroups = module.global_variables.iter().filter(|(_, one)| one.space == AddressSpace::WorkGroup);
    Some(of_workgroups.map(|(_, one)| u64::from(layouter[one.ty].size).next_multiple_of(16)).sum())
}

#[cfg(test)]
mod tests {
    use super::*;
    use barchan_core::coupling::{DeviceAnswer, DeviceGroup};

    const GRIPS: &str = "fn coupling_distance(body: u32, x: vec3<f32>, cell: f32) -> f32 { return length(x); }\n\
        fn coupling_grip(body: u32, x: vec3<f32>, cell: f32, press: vec3<f32>) -> CouplingGrip { return CouplingGrip(GRIP_NONE, x, 0.0, false, 1.0); }\n\
        fn coupling_friction(body: u32) -> f32 { return coupling_table(body).x; }\n\
        fn coupling_box(body: u32, rows: array<vec3<f32>, 3>, cell: f32) -> array<vec3<f32>, 2> { return array<vec3<f32>, 2>(-rows[0], rows[0]); }\n";
    const ANSWERS: &str = "var<workgroup> part: f32;\n\
        fn coupling_begin(group: u32, thread: u32) { set_group_twist(TWIST_FREE, 0u, group_twist(TWIST_TRIED, 0u)); }\n\
        fn coupling_answer(group: u32, thread: u32) { part = group_system(0u).force.x; workgroupBarrier(); }\n\
        fn coupling_balance(group: u32, along: u32, thread: u32) -> f32 { return 0.0; }\n\
        fn coupling_twice_energy(group: u32, which: u32, thread: u32) -> f32 { return 0.0; }\n\
        fn coupling_feel(group: u32, thread: u32) {}\n\
        fn coupling_advance(group: u32, thread: u32) { if group_moves() { storageBarrier(); } set_group_pose(0u, group_pose(0u)); }\n";

    fn law(wgsl: &str, answer: &str) -> DeviceLaw {
        let groups = if answer.is_empty() { Vec::new() } else { vec![DeviceGroup::default()] };
        let answer = DeviceAnswer { wgsl: answer.to_owned(), groups };
        DeviceLaw { counted: true, wgsl: wgsl.to_owned(), answer, ..DeviceLaw::default() }
    }

    #[test]
    fn all_that_functions_of_groups_may_use_stands_in_the_pass() {
        let text = stand_ins(&[]);
        let names = declared_names(&text);
        for name in STRUCTURES.iter().chain(&CONSTANTS).chain(&FUNCTIONS_OF_PASS) {
            assert!(names.iter().any(|declared| declared == name), "{name} is not in\n{text}");
        }
        check_law(&law(GRIPS, ANSWERS), false).unwrap();
    }

    #[test]
    fn what_is_wrong_is_told_by_its_text_and_line() {
        let begin = "fn coupling_begin(group: u32, thread: u32)";
        for (grips, answers, said) in [
            (GRIPS.replace("length(x)", "lenght(x)"), ANSWERS.to_owned(), "WGSL line 1: "),
            (GRIPS.to_owned(), ANSWERS.replacen("0.0; }\n", "1u; }\n", 1), "WGSL of the answer line 4: "),
            (GRIPS.to_owned(), ANSWERS.replace("group_system", "exchange"), "exchange"),
            (GRIPS.replace("coupling_box", "coupling_boxes"), ANSWERS.to_owned(), "no function coupling_box"),
            (GRIPS.to_owned(), ANSWERS.replace("coupling_feel", "coupling_fell"), "no function coupling_feel"),
            (GRIPS.to_owned(), ANSWERS.replace(begin, "fn coupling_begin(thread: u32)"), "other arguments"),
            (GRIPS.to_owned(), ["@binding(0) ", ANSWERS].concat(), "'binding' at module scope"),
        ] {
            let refused = check_law(&law(&grips, &answers), false).expect_err("a text that must be refused");
            assert!(refused.what.contains(said), "{said}: {refused:?}");
        }
        let none = check_law(&law(GRIPS, ""), true).expect_err("a field without a law");
        assert!(none.what.contains("no function coupling_field") && none.mend.contains("dt: f32"), "{none:?}");
    }
}
