//! Materials in WGSL: each is checked alone, so that an error names the material and its own line, then all of a scene's
//! laws become one text with a function that picks among them.

use crate::passes::wgsl_words::words_at_module_scope;
use barchan_core::{Error, Material, Result};
use naga::valid::{Capabilities, ModuleInfo, ShaderStages, ValidationFlags, Validator};
use std::error::Error as _;
use std::fmt::Write as _;

/// What a material's WGSL may use.
const PRELUDE: &str = include_str!("../prelude.wgsl");

/// What the engine supplies to a material checked alone, and a function of the type that its update must have.
const HOST: &str = "
fn barchan_param(base: u32, i: u32) -> f32 { return f32(base + i); }
fn barchan_update(x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut {
    return MatOut(x.strain, x.vel_grad);
}
fn barchan_stiffness_of(strain: mat3x3<f32>, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> Stiffness {
    return Stiffness(1.0, 1.0, 0.0);
}
";

/// A function that a material defines: what stands behind its name, the function whose type it must have, and that type.
type Wanted = (&'static str, &'static str, &'static str);
const UPDATE: Wanted =
    ("update", "barchan_update", "(x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut");
const STIFFNESS: Wanted = (
    "stiffness",
    "barchan_stiffness_of",
    "(strain: mat3x3<f32>, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> Stiffness",
);

/// Checks a material's WGSL alone: it parses and is valid without any optional capability of a device, defines
/// `<name>_update` of the right type, and `<name>_stiffness` if it has text for that, starts all its names with its own, and has neither
/// variables, constants set from outside nor entry points at module scope, nor barriers.
///
/// # Errors
/// [`Error::Missing`] if there is no WGSL, [`Error::Plugin`] naming the material, its library and the line.
pub fn check(material: &Material) -> Result<()> {
    if material.wgsl.is_empty() {
        return Err(Error::Missing {
            kind: "material",
            name: material.name.clone(),
            origin: material.origin.clone(),
            what: "WGSL".to_owned(),
            why: "the backend wgpu runs the law on a GPU".to_owned(),
            mend: format!("supply {}_update in the table's slot wgsl, or use the backend cpu", material.name),
        });
    }
    let texts = [("WGSL", &*material.wgsl), ("WGSL of the stiffness", &*material.wgsl_stiffness)];
    check_texts(&material.name, material.states.len(), texts.map(|(_, text)| text)).map_err(|refusal| {
        let Refusal { text, line, what, mend } = refusal;
        let place = line.map_or_else(String::new, |line| format!(" line {line}"));
        Error::Plugin {
            library: material.origin.clone().into(),
            what: format!("material '{}': {}{place}: {what}", material.name, texts[text].0),
            mend,
        }
    })
}

/// The prelude, the WGSL of all laws, each once, and
///
/// ```wgsl
/// fn update_material(law: u32, x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut
/// fn gives_stiffness(law: u32) -> bool
/// fn stiffness_of_material(law: u32, strain: mat3x3<f32>, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> Stiffness
/// ```
///
/// which call the law at position `law` of `laws`; the stiffness is zero of one that gives none. The engine adds
/// `fn barchan_param(base: u32, i: u32) -> f32`, which reads parameter `i` of a material whose parameters begin at `base`.
///
/// # Errors
/// Those of [`check`] for the first law that fails it.
pub fn module(laws: &[&Material]) -> Result<String> {
    laws.iter().try_for_each(|law| check(law))?;
    let states = laws.iter().map(|law| law.states.len()).max().unwrap_or(0);
    let mut text = prelude(states);
    for (i, law) in laws.iter().enumerate() {
        if !laws[..i].iter().any(|earlier| earlier.name == law.name) {
            let _ = writeln!(text, "{}\n{}", law.wgsl, law.wgsl_stiffness);
        }
    }
    let mut pick = |signature: &str, none: &str, of: &dyn Fn(&Material) -> String| {
        let (first, others) = laws.split_first().map_or((none.to_owned(), &[][..]), |(first, rest)| (of(first), rest));
        let case = |(i, law): (usize, &&Material)| format!("case {}u: {{ return {}; }}\n", i + 1, of(law));
        let cases: String = others.iter().enumerate().map(case).collect();
        let _ = writeln!(text, "fn {signature} {{\nswitch law {{\n{cases}default: {{ return {first}; }}\n}}\n}}");
    };
    const STATE: &str = "ptr<function, array<f32, BARCHAN_MAX_STATE>>";
    pick(
        &format!("update_material(law: u32, x: MatIn, base: u32, q: {STATE}) -> MatOut"),
        "MatOut(x.strain, mat3x3<f32>())",
        &|law| format!("{}_update(x, base, q)", law.name),
    );
    let gives = |law: &Material| !law.wgsl_stiffness.is_empty();
    pick("gives_stiffness(law: u32) -> bool", "false", &|law| gives(law).to_string());
    pick(
        &format!("stiffness_of_material(law: u32, strain: mat3x3<f32>, base: u32, q: {STATE}) -> Stiffness"),
        "Stiffness()",
        &|law| if gives(law) { format!("{}_stiffness(strain, base, q)", law.name) } else { "Stiffness()".to_owned() },
    );
    Ok(text)
}

/// The prelude for materials of at most `states` state variables.
fn prelude(states: usize) -> String {
    // WGSL has no arrays of length 0.
    format!("const BARCHAN_MAX_STATE: u32 = {}u;\n{PRELUDE}\n", states.max(1))
}

/// Why a text is refused.
#[derive(Debug)]
struct Refusal {
    /// Which of the material's texts, and its line, from 1.
    text: usize,
    line: Option<usize>,
    what: String,
    mend: String,
}

impl Refusal {
    fn new(line: Option<usize>, what: impl Into<String>, mend: impl Into<String>) -> Self {
        Self { text: 0, line, what: what.into(), mend: mend.into() }
    }
}

/// Checks the text of the update, and that of the stiffness, which may be empty and call what is in the first.
fn check_texts(name: &str, states: usize, texts: [&str; 2]) -> Result<(), Refusal> {
    for (text, wgsl) in texts.iter().enumerate() {
        check_declarations(name, wgsl).map_err(|refusal| Refusal { text, ..refusal })?;
    }
    let before = prelude(states) + HOST;
    let source = format!("{before}{}\n{}", texts[0], texts[1]);
    let firsts = [before.lines().count(), before.lines().count() + texts[0].split('\n').count()];
    let at_own = |refusal: Refusal, line: Option<u32>| {
        let line = line.map_or(0, |line| line as usize);
        let text = usize::from(line > firsts[1]);
        Refusal { text, line: line.checked_sub(firsts[text]).filter(|line| *line > 0), ..refusal }
    };
    let module = naga::front::wgsl::parse_str(&source).map_err(|error| {
        let mend = "correct it; backends/wgpu/src/prelude.wgsl says what may be used";
        at_own(Refusal::new(None, error.message(), mend), error.location(&source).map(|at| at.line_number))
    })?;
    let info = Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(&module).map_err(|error| {
        let mut what = error.as_inner().to_string();
        let mut cause = error.as_inner().source();
        while let Some(deeper) = cause {
            let _ = write!(what, ": {deeper}");
            cause = deeper.source();
        }
        let mend = "correct it; no optional feature of a device may be used";
        at_own(Refusal::new(None, what, mend), error.location(&source).map(|at| at.line_number))
    })?;
    check_purity(&module, &info, name)?;
    check_function(&module, name, UPDATE)?;
    if texts[1].is_empty() {
        return Ok(());
    }
    check_function(&module, name, STIFFNESS).map_err(|refusal| Refusal { text: 1, ..refusal })
}

/// Nothing but functions that any stage could call.
fn check_purity(module: &naga::Module, info: &ModuleInfo, name: &str) -> Result<(), Refusal> {
    let mend = format!("write pure functions, called by {name}_update");
    if !module.entry_points.is_empty() || !module.global_variables.is_empty() || !module.overrides.is_empty() {
        return Err(Refusal::new(None, "it declares an entry point or a variable at module scope", mend));
    }
    for (handle, function) in module.functions.iter() {
        if info[handle].available_stages != ShaderStages::all() {
            let called = function.name.as_deref().unwrap_or("a function");
            return Err(Refusal::new(None, format!("{called} has barriers or the like, which need neighbours"), mend));
        }
    }
    Ok(())
}

/// The function is there and of the model's type.
fn check_function(module: &naga::Module, name: &str, (suffix, model, ty): Wanted) -> Result<(), Refusal> {
    let wanted = format!("{name}_{suffix}");
    let find = |name: &str| module.functions.iter().map(|(_, f)| f).find(|f| f.name.as_deref() == Some(name));
    let type_of = |f: &naga::Function| {
        let arguments: Vec<_> = f.arguments.iter().map(|a| a.ty).collect();
        (arguments, f.result.as_ref().map(|r| r.ty))
    };
    let Some(own) = find(&wanted) else {
        return Err(Refusal::new(None, format!("there is no function {wanted}"), format!("define fn {wanted}{ty}")));
    };
    if find(model).map(type_of) != Some(type_of(own)) {
        return Err(Refusal::new(
            None,
            format!("{wanted} has other arguments or another result than it must"),
            format!("define fn {wanted}{ty}"),
        ));
    }
    Ok(())
}

/// Names at module scope start with the material's, and what would reach outside is not declared there.
fn check_declarations(name: &str, wgsl: &str) -> Result<(), Refusal> {
    let mut words = words_at_module_scope(wgsl).peekable();
    while let Some((line, word)) = words.next() {
        match word.as_str() {
            "fn" | "const" | "struct" | "alias" => {
                let Some((line, declared)) = words.peek() else { continue };
                if !declared.starts_with(&format!("{name}_")) {
                    return Err(Refusal::new(
                        Some(*line),
                        format!("'{declared}' does not start with '{name}_'"),
                        format!("call it {name}_{declared}: the laws of a scene share one module"),
                    ));
                }
            }
            "var" | "override" => {
                let what = format!("'{word}' at module scope");
                return Err(Refusal::new(
                    Some(line),
                    what,
                    "a law is a pure function: use const, or the function's arguments",
                ));
            }
            "compute" | "vertex" | "fragment" => {
                return Err(Refusal::new(
                    Some(line),
                    format!("an entry point (@{word})"),
                    "leave it out: the engine calls the update",
                ));
            }
            "enable" | "requires" | "diagnostic" => {
                return Err(Refusal::new(
                    Some(line),
                    format!("the directive '{word}'"),
                    "leave it out: a law must run on every device",
                ));
            }
            _ => {}
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIGNATURE: &str = "(x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut { return MatOut(x.strain, x.vel_grad); }";

    const STIFFNESS_TYPE: &str = STIFFNESS.2;

    /// What is said of a text for a material 'toy' of two state variables.
    fn refusal(wgsl: &str) -> Refusal {
        check_texts("toy", 2, [wgsl, ""]).expect_err("a text that must be refused")
    }

    #[test]
    fn a_pure_update_with_helpers_of_its_own_is_accepted() {
        let text = "// fn other() in a comment, /* and so on\nconst toy_ONE = 1.0;\nstruct toy_Law { e: f32 }\nalias toy_Number = f32;\n/* fn foreign() {} */\n\
             fn toy_law(base: u32) -> toy_Law { const local = 2.0; return toy_Law(local * barchan_param(base, 0u)); }\n\
             fn toy_update(x: MatIn, base: u32, q: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut {\n\
             (*q)[1] = toy_law(base).e * barchan_log1p(x.dt);\n return MatOut(x.strain, x.vel_grad); }";
        check_texts("toy", 2, [text, ""]).unwrap();
        // The stiffness may call what stands beside the update.
        let stiffness =
            format!("fn toy_stiffness{STIFFNESS_TYPE} {{ return Stiffness(toy_law(base).e, toy_ONE, 0.0); }}");
        check_texts("toy", 2, [text, &stiffness]).unwrap();
    }

    #[test]
    fn what_is_wrong_with_the_stiffness_is_told_by_its_own_line() {
        let update = format!("fn toy_update{SIGNATURE}\n");
        for (text, line, said) in [
            ("\nfn other() {}", Some(2), "'other'"),
            ("\n\nfn toy_stiffness() -> f32 { return vec9(1.0); }", Some(3), "vec9"),
            ("\nfn toy_stiffness() -> f32 { return 1u; }", Some(2), ""),
            ("fn toy_stiff() {}", None, "no function toy_stiffness"),
            ("fn toy_stiffness(x: f32) -> f32 { return x; }", None, "arguments"),
        ] {
            let refused = check_texts("toy", 2, [&update, text]).expect_err("a text that must be refused");
            assert_eq!((refused.text, refused.line), (1, line), "{text}: {refused:?}");
            assert!(refused.what.contains(said), "{text}: {refused:?}");
        }
    }

    #[test]
    fn each_thing_that_a_law_may_not_have_is_refused_at_its_line() {
        for (before, line, said) in [
            ("\n@compute @workgroup_size(1) fn toy_main() {}\n", Some(2), "entry point"),
            ("\n\nvar<private> toy_x: f32;\n", Some(3), "'var'"),
            ("@group(0) @binding(0) var<storage> toy_x: array<f32>;\n", Some(1), "'var'"),
            ("override toy_x: f32 = 1.0;\n", Some(1), "'override'"),
            ("enable f16;\n", Some(1), "'enable'"),
            ("\nfn helper() {}\n", Some(2), "'helper' does not start with 'toy_'"),
            ("const ONE: f32 = 1.0;\n", Some(1), "'ONE'"),
            ("/* a\n comment */ struct Law { e: f32 }\n", Some(2), "'Law'"),
            ("alias Number = f32;\n", Some(1), "'Number'"),
            ("\n\nfn toy_f() -> f32 { return vec9(1.0); }\n", Some(3), "vec9"),
            ("\nfn toy_f() -> f32 { return 1.0 }\n", Some(2), "expected"),
            ("\n\n\nfn toy_f() -> f32 { return 1u; }\n", Some(4), ""),
            ("fn toy_f(x: f32) -> f32 { return subgroupAdd(x); }\n", Some(1), ""),
            ("fn toy_f() { workgroupBarrier(); }\n", None, "toy_f has barriers"),
            ("fn toy_f(x: f32) -> f32 { return engine_density(x); }\n", Some(1), "engine_density"),
        ] {
            let refused = refusal(&format!("{before}fn toy_update{SIGNATURE}\n"));
            assert_eq!(refused.line, line, "{before}: {refused:?}");
            assert!(refused.what.contains(said), "{before}: {refused:?}");
        }
    }

    #[test]
    fn a_missing_or_mistyped_update_is_refused() {
        let missing = refusal("fn toy_updated() {}\n");
        assert!(missing.what.contains("no function toy_update") && missing.mend.contains("MatIn"), "{missing:?}");
        let other = refusal("fn toy_update(x: MatIn) -> MatOut { return MatOut(x.strain, x.strain); }\n");
        assert!(other.what.contains("arguments"), "{other:?}");
        // Two state variables are declared: a third is beyond the array.
        let beyond = SIGNATURE.replace("{ return", "{ (*q)[2] = 1.0; return");
        assert_eq!(refusal(&format!("\nfn toy_update{beyond}")).line, Some(2));
    }

    #[test]
    fn an_open_brace_does_not_swallow_what_follows() {
        let refused = refusal(&format!("fn toy_f() {{\nfn toy_update{SIGNATURE}\n"));
        assert!(refused.line.is_some(), "{refused:?}");
    }
}
