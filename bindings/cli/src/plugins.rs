//! `barchan plugins`.

use crate::print::show;
use barchan::parameter::{Kind, Parameter, Value as Setting, after_number};
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
            let value = number(s.initial) + &after_number(&s.unit);
            text += &format!("      {:<21} {value:<15} {:<17} {}\n", s.name, "state", s.doc);
        }
    }
    let mut section = |title: &str, entries: &mut dyn Iterator<Item = (String, String, Vec<Parameter>)>| {
        text += &format!("{title}\n");
        for (name, doc, parameters) in entries {
            text += &format!("  {name:<19} {doc}\n");
            text.extend(parameters.iter().map(as_line));
        }
    };
    section("couplings", &mut couplings(registry));
    section("backends", &mut backends(registry));
    section("tasks", &mut tasks(registry));
    section("observers", &mut observers(registry));
    section("scenes", &mut scenes().into_iter().map(|(name, doc)| (name, doc, Vec::new())));
    text
}

fn couplings(registry: &Registry) -> impl Iterator<Item = (String, String, Vec<Parameter>)> {
    registry.couplings().map(|(name, kind)| (name.to_owned(), kind.doc.clone(), kind.parameters.clone()))
}
fn backends(registry: &Registry) -> impl Iterator<Item = (String, String, Vec<Parameter>)> {
    registry.backends().map(|backend| (backend.name().to_owned(), backend.doc().to_owned(), backend.parameters()))
}
fn tasks(registry: &Registry) -> impl Iterator<Item = (String, String, Vec<Parameter>)> {
    registry.tasks().map(|(name, kind)| (name.to_owned(), kind.doc.clone(), kind.parameters.clone()))
}

/// What observers see is the scene and the simulation: they have no parameters.
fn observers(registry: &Registry) -> impl Iterator<Item = (String, String, Vec<Parameter>)> {
    registry.observers().map(|(name, doc)| (name.to_owned(), doc.to_owned(), Vec::new()))
}

/// A parameter: name, default, range or type, what it is; below it the keys of a table.
fn as_line(p: &Parameter) -> String {
    indented(p, 6)
}

fn indented(p: &Parameter, by: usize) -> String {
    let (value, width) = (with_unit(p), 27 - by);
    let line = format!("{:by$}{:<width$} {value:<15} {:<17} {}\n", "", p.name, range(&p.kind), p.doc);
    keys(&p.kind).iter().fold(line, |lines, key| lines + &indented(key, by + 2))
}

/// The keys of a table, or of each table of an array.
fn keys(kind: &Kind) -> &[Parameter] {
    match kind {
        Kind::Table(keys) => keys,
        Kind::Array { of, .. } => keys(of),
        _ => &[],
    }
}

/// The default and its unit.
fn with_unit(p: &Parameter) -> String {
    let value = match &p.default {
        Some(value) => setting(value),
        None if matches!(p.kind, Kind::Table(_)) => String::new(),
        None => "required".to_owned(),
    };
    (value + &after_number(&p.unit)).trim_start().to_owned()
}

/// A default with short numbers.
fn setting(value: &Setting) -> String {
    match value {
        Setting::Number(x) => number(*x),
        Setting::Switch(on) => on.to_string(),
        Setting::Text(text) => format!("{text:?}"),
        Setting::Path { .. } => "none".to_owned(),
        Setting::Array(items) => format!("[{}]", items.iter().map(setting).collect::<Vec<_>>().join(", ")),
        Setting::Table(_) => "{…}".to_owned(),
    }
}

/// A number with at most four digits.
fn number(value: f64) -> String {
    match value.abs() {
        v if v != 0.0 && v.is_finite() && !(1e-3..1e5).contains(&v) => {
            let text = format!("{value:.3e}");
            let (digits, exponent) = text.split_once('e').unwrap_or((&text, "0"));
            format!("{}e{exponent}", digits.trim_end_matches('0').trim_end_matches('.'))
        }
        _ => ((value * 1e4).round() / 1e4).to_string(),
    }
}

/// The range with short numbers, or what else may be given.
fn range(kind: &Kind) -> String {
    match kind {
        Kind::Number(range) => range.written(number),
        Kind::Text(choices) if !choices.is_empty() => choices.join(" | "),
        Kind::Array { of, count } => {
            let count = match (count.start(), count.end()) {
                (a, b) if a == b => a.to_string(),
                (a, &usize::MAX) => format!("{a}+"),
                (a, b) => format!("{a}-{b}"),
            };
            format!("{count} x {}", range(of))
        }
        other => other.name().to_owned(),
    }
}

fn as_json(registry: &Registry) -> Value {
    let parameter = parameter_json;
    let material = |m: &Material| {
        json!({
            "name": m.name, "version": m.version, "origin": m.origin, "doc": m.doc, "reference": m.reference,
            "parameters": m.parameters.iter().map(parameter).collect::<Vec<_>>(),
            "states": m.states.iter()
                .map(|s| json!({ "name": s.name, "unit": s.unit, "initial": s.initial, "doc": s.doc }))
                .collect::<Vec<_>>(),
        })
    };
    let all = |entries: &mut dyn Iterator<Item = (String, String, Vec<Parameter>)>| -> Vec<Value> {
        let one = |(name, doc, parameters): (String, String, Vec<Parameter>)| json!({ "name": name, "doc": doc, "parameters": parameters.iter().map(parameter).collect::<Vec<_>>() });
        entries.map(one).collect()
    };
    let scene = |(name, doc): (String, String)| json!({ "name": name, "doc": doc });
    json!({
        "materials": registry.materials().map(material).collect::<Vec<_>>(),
        "couplings": all(&mut couplings(registry)),
        "backends": all(&mut backends(registry)),
        "tasks": all(&mut tasks(registry)),
        "observers": all(&mut observers(registry)),
        "scenes": scenes().into_iter().map(scene).collect::<Vec<_>>(),
    })
}

/// A parameter; "default" is null where it is required, and what does not go with its type is absent.
fn parameter_json(p: &Parameter) -> Value {
    let mut value = kind_json(&p.kind);
    value["name"] = json!(p.name);
    value["unit"] = json!(p.unit);
    value["doc"] = json!(p.doc);
    value["default"] = p.default.as_ref().map_or(Value::Null, setting_json);
    value
}

fn kind_json(kind: &Kind) -> Value {
    let mut value = json!({ "type": kind.name() });
    match kind {
        Kind::Number(range) => {
            value["min"] = json!(range.min);
            value["max"] = json!(range.max);
            value["range"] = json!(range.to_string());
        }
        Kind::Text(choices) if !choices.is_empty() => value["choices"] = json!(choices),
        Kind::Array { of, count } => {
            value["of"] = kind_json(of);
            value["min_count"] = json!(count.start());
            value["max_count"] = if *count.end() == usize::MAX { Value::Null } else { json!(count.end()) };
        }
        Kind::Table(keys) => value["keys"] = keys.iter().map(parameter_json).collect(),
        _ => {}
    }
    value
}

fn setting_json(value: &Setting) -> Value {
    match value {
        Setting::Number(x) => json!(x),
        Setting::Switch(on) => json!(on),
        Setting::Text(text) => json!(text),
        Setting::Path { given, .. } => json!(given),
        Setting::Array(items) => items.iter().map(setting_json).collect(),
        // A table has no default of its own.
        Setting::Table(_) => Value::Null,
    }
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
        let texts = [0.0, 0.3, 1e5, 1.4e5, std::f64::consts::FRAC_PI_4, 1e-6, -1.0, f64::INFINITY].map(number);
        assert_eq!(texts, ["0", "0.3", "1e5", "1.4e5", "0.7854", "1e-6", "-1", "inf"]);
    }

    #[test]
    fn both_forms_name_every_parameter() {
        let registry = barchan::registry();
        let (text, json) = (as_text(&registry), as_json(&registry));
        for material in registry.materials() {
            let listed = json["materials"].as_array().unwrap().iter().find(|m| m["name"] == material.name.as_str());
            let listed = listed.unwrap_or_else(|| panic!("{} is not listed", material.name));
            for (i, parameter) in material.parameters.iter().enumerate() {
                assert!(text.contains(&format!(" {}\n", parameter.doc)), "{}", parameter.name);
                assert_eq!(listed["parameters"][i]["default"].as_f64(), parameter.default_number());
            }
        }
        assert!(text.contains("letters") && text.contains("cpu"));
        // Columns do not run together.
        assert!(text.contains("equivalent_plastic_strain 0 "), "{text}");
        assert!(text.contains("both | none What the agent"), "{text}");
    }
}
