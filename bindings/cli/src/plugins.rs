//! `barchan plugins`.

use crate::print::show;
use barchan::material::Parameter;
use barchan::{Material, Registry, Result};
use clap::Args;
use serde_json::{Value, json};
use std::path::PathBuf;

#[derive(Args)]
pub(crate) struct PluginArgs {
    /// A library with materials to load; may be given again.
    #[arg(long, value_name = "LIBRARY")]
    load: Vec<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(crate) fn list(args: &PluginArgs, registry: Registry) -> Result<()> {
    let registry = crate::load(registry, &args.load)?;
    if args.json {
        show(format!("{:#}\n", as_json(&registry)));
    } else {
        show(as_text(&registry));
    }
    Ok(())
}

/// Adapters by backend, numbered as `--adapter` takes them.
pub(crate) fn adapters(registry: &Registry) -> String {
    let mut text = String::new();
    for backend in registry.backends() {
        let Some(adapters) = backend.adapters() else { continue };
        text += &format!("{}\n", backend.name());
        for (number, adapter) in adapters.iter().enumerate() {
            text += &format!("  {number}  {}\n     {}\n", adapter.name, adapter.doc);
        }
        if adapters.is_empty() {
            text += "  none: install the driver of a GPU, or a software one (apt-get install mesa-vulkan-drivers)\n";
        }
    }
    if text.is_empty() { "no backend runs on adapters\n".to_owned() } else { text }
}

fn as_text(registry: &Registry) -> String {
    let mut text = String::from("materials\n");
    for material in registry.materials() {
        text += &format!("  {} {} ({})\n", material.name, material.version, material.origin);
        text += &format!("      {}\n      {}\n", material.doc, material.reference);
        text.extend(material.parameters.iter().map(as_line));
        for s in &material.states {
            let value = format!("{} {}", number(s.initial), s.unit);
            text += &format!("      {:<22}{value:<16}{:<18}{}\n", s.name, "state", s.doc);
        }
    }
    text += "couplings\n";
    for (name, kind) in registry.couplings() {
        text += &format!("  {name:<20}{}\n", kind.doc);
        text.extend(kind.parameters.iter().map(as_line));
    }
    let mut section = |title: &str, entries: &mut dyn Iterator<Item = (String, String)>| {
        text += &format!("{title}\n");
        entries.for_each(|(name, doc)| text += &format!("  {name:<20}{doc}\n"));
    };
    let pair = |(name, doc): (&str, &str)| (name.to_owned(), doc.to_owned());
    section("backends", &mut registry.backends().map(|b| pair((b.name(), b.doc()))));
    section("tasks", &mut registry.tasks().map(pair));
    section("scenes", &mut scenes().into_iter());
    text
}

/// A parameter: name, default, range, what it is.
fn as_line(p: &Parameter) -> String {
    let value = format!("{} {}", number(p.default), p.unit);
    format!("      {:<22}{value:<16}{:<18}{}\n", p.name, range(p), p.doc)
}

/// A number with at most four digits.
fn number(value: f64) -> String {
    match value.abs() {
        v if v != 0.0 && !(1e-3..1e5).contains(&v) => {
            let text = format!("{value:.3e}");
            let (digits, exponent) = text.split_once('e').unwrap_or((&text, "0"));
            format!("{}e{exponent}", digits.trim_end_matches('0').trim_end_matches('.'))
        }
        _ => ((value * 1e4).round() / 1e4).to_string(),
    }
}

/// The range with short numbers, brackets as declared.
fn range(p: &Parameter) -> String {
    let exact = p.range();
    let (open, close) = (exact.starts_with('('), exact.ends_with(')'));
    let (open, close) = (if open { '(' } else { '[' }, if close { ')' } else { ']' });
    format!("{open}{}, {}{close}", number(p.min), number(p.max))
}

fn as_json(registry: &Registry) -> Value {
    let parameter = |p: &Parameter| {
        json!({
            "name": p.name, "unit": p.unit, "default": p.default, "min": p.min, "max": p.max, "range": p.range(),
            "doc": p.doc,
        })
    };
    let material = |m: &Material| {
        json!({
            "name": m.name, "version": m.version, "origin": m.origin, "doc": m.doc, "reference": m.reference,
            "parameters": m.parameters.iter().map(parameter).collect::<Vec<_>>(),
            "states": m.states.iter()
                .map(|s| json!({ "name": s.name, "unit": s.unit, "initial": s.initial, "doc": s.doc }))
                .collect::<Vec<_>>(),
        })
    };
    let pairs = |entries: &mut dyn Iterator<Item = (String, String)>| -> Vec<Value> {
        entries.map(|(name, doc)| json!({ "name": name, "doc": doc })).collect()
    };
    let pair = |(name, doc): (&str, &str)| (name.to_owned(), doc.to_owned());
    json!({
        "materials": registry.materials().map(material).collect::<Vec<_>>(),
        "couplings": registry.couplings().map(|(name, kind)| json!({
            "name": name, "doc": kind.doc, "parameters": kind.parameters.iter().map(parameter).collect::<Vec<_>>(),
        })).collect::<Vec<_>>(),
        "backends": pairs(&mut registry.backends().map(|b| pair((b.name(), b.doc())))),
        "tasks": pairs(&mut registry.tasks().map(pair)),
        "scenes": pairs(&mut scenes().into_iter()),
    })
}

/// Built-in scenes and their one sentence.
fn scenes() -> Vec<(String, String)> {
    let doc = |name| barchan::tasks::scene(name, &[] as &[&str]).map(|scene| scene.doc).unwrap_or_default();
    barchan::tasks::names().map(|name| (name.to_owned(), doc(name))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        let texts = [0.0, 0.3, 1e5, 1.4e5, std::f64::consts::FRAC_PI_4, 1e-6, -1.0].map(number);
        assert_eq!(texts, ["0", "0.3", "1e5", "1.4e5", "0.7854", "1e-6", "-1"]);
    }

    #[test]
    fn both_forms_name_every_parameter() {
        let registry = barchan::registry();
        let (text, json) = (as_text(&registry), as_json(&registry));
        for material in registry.materials() {
            let listed = json["materials"].as_array().unwrap().iter().find(|m| m["name"] == material.name.as_str());
            let listed = listed.unwrap_or_else(|| panic!("{} is not listed", material.name));
            for (i, parameter) in material.parameters.iter().enumerate() {
                assert!(text.contains(&parameter.doc), "{}", parameter.name);
                assert_eq!(listed["parameters"][i]["default"], parameter.default);
            }
        }
        assert!(text.contains("letters") && text.contains("cpu"));
    }
}
