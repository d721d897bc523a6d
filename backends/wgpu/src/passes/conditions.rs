//! Conditions in the text of passes: those of WESL, an extension of WGSL (conditional translation), as far as passes need them. `@if(a && !b)` before a
//! statement or a declaration, then perhaps `@elif(c)` or `@else` before the next ones, each at the beginning of a line.
//!
//! Why the crate `wesl` does not do it: see `docs/choices.md`.

/// What a condition is called, and whether it holds.
pub(crate) type Condition<'a> = (&'a str, bool);

/// The text with what these conditions choose.
pub(crate) fn chosen(text: &str, conditions: &[Condition<'_>]) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    // Has one of an `@if` and what follows on it been chosen?
    let mut is_done = false;
    while let Some((before, attribute, behind)) = next_attribute(rest) {
        out += before;
        let (wanted, node) = match attribute {
            "@else" => (!is_done, behind),
            _ => {
                let (expression, node) = in_parentheses(behind);
                is_done &= attribute == "@elif";
                (!is_done && holds(expression, conditions), node)
            }
        };
        is_done |= wanted;
        let node = node.trim_start_matches([' ', '\n']);
        let (node, after) = node.split_at(length_of_node(node));
        if wanted {
            // Within it there may be others.
            out += &chosen(node, conditions);
        }
        rest = after;
    }
    out + rest
}

/// What stands before the next attribute, the attribute, and what stands behind it. It begins a line: comments may speak of it.
fn next_attribute(text: &str) -> Option<(&str, &str, &str)> {
    let mut at = 0;
    for line in text.split_inclusive('\n') {
        let indented = line.trim_start();
        let begin = at + line.len() - indented.len();
        let found = ["@if", "@elif", "@else"].into_iter().find(|attribute| {
            let behind = indented.strip_prefix(attribute);
            behind.is_some_and(|behind| !behind.starts_with(|c: char| c.is_alphanumeric() || c == '_'))
        });
        if let Some(attribute) = found {
            return Some((&text[..begin], attribute, &text[begin + attribute.len()..]));
        }
        at += line.len();
    }
    None
}

/// What stands in the parentheses at the beginning of a text, and what stands behind them.
fn in_parentheses(text: &str) -> (&str, &str) {
    let mut depth = 0;
    for (at, c) in text.char_indices() {
        match c {
            '(' => depth += 1,
            ')' if depth == 1 => return (&text[1..at], &text[at + 1..]),
            ')' => depth -= 1,
            _ => {}
        }
    }
    panic!("a condition in the text of a pass has no end: tests go through all of them")
}

/// How long the statement or declaration is at the beginning of a text: to a semicolon or a closing brace outside of all others; what follows on an `if`
/// is part of it.
fn length_of_node(text: &str) -> usize {
    let (mut depth, mut is_comment) = (0, false);
    for (at, c) in text.char_indices() {
        if is_comment || text[at..].starts_with("//") {
            is_comment = c != '\n';
            continue;
        }
        match c {
            '(' | '[' | '{' => depth += 1,
            ')' | ']' => depth -= 1,
            '}' => {
                depth -= 1;
                if depth == 0 && !text[at + 1..].trim_start().starts_with("else") {
                    return at + 1;
                }
            }
            ';' if depth == 0 => return at + 1,
            _ => {}
        }
    }
    panic!("a statement in the text of a pass has no end: tests go through all of them")
}

/// Does an expression of conditions hold? Names, `!`, `&&`, `||` and parentheses, of which `&&` binds more closely.
fn holds(expression: &str, conditions: &[Condition<'_>]) -> bool {
    let expression = expression.trim();
    for (operator, of_both) in [("||", (|a, b| a || b) as fn(bool, bool) -> bool), ("&&", |a, b| a && b)] {
        if let Some(at) = outside_parentheses(expression, operator) {
            let [left, right] = [&expression[..at], &expression[at + 2..]].map(|operand| holds(operand, conditions));
            return of_both(left, right);
        }
    }
    if let Some(operand) = expression.strip_prefix('!') {
        return !holds(operand, conditions);
    }
    if expression.starts_with('(') {
        return holds(in_parentheses(expression).0, conditions);
    }
    let known = conditions.iter().find(|(name, _)| *name == expression);
    known.expect("whoever asks for the text of a pass names its conditions: tests go through all of them").1
}

/// Where an operator stands first outside of parentheses.
fn outside_parentheses(expression: &str, operator: &str) -> Option<usize> {
    let mut depth = 0;
    expression.char_indices().find_map(|(at, c)| {
        depth += i32::from(c == '(') - i32::from(c == ')');
        (depth == 0 && expression[at..].starts_with(operator)).then_some(at)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;
    use std::path::Path;
    use wgpu::naga::front::wgsl::parse_str;

    const TEXT: &str = "// An @if in a comment.\n@if(a)\nvar<private> x: u32;\nfn f() {\n    @if(a && !b) g(1);\n    @elif(b)\n    if c() {\n        g(2);\n    } \
        else {\n        @if(a) g(3);\n        @else g(4);\n    }\n    @else { g(5); }\n    g(6);\n}\n@if(!(a || b)) fn g(n: u32) {}\n";

    fn words(a: bool, b: bool) -> Vec<String> {
        chosen(TEXT, &[("a", a), ("b", b)]).split_whitespace().skip(6).map(str::to_owned).collect()
    }

    #[test]
    fn conditions_choose_statements_and_declarations() {
        let as_words = |text: &str| text.split_whitespace().map(str::to_owned).collect::<Vec<_>>();
        assert_eq!(words(true, false), as_words("var<private> x: u32; fn f() { g(1); g(6); }"));
        assert_eq!(
            words(true, true),
            as_words("var<private> x: u32; fn f() { if c() { g(2); } else { g(3); } g(6); }")
        );
        assert_eq!(words(false, true), as_words("fn f() { if c() { g(2); } else { g(4); } g(6); }"));
        assert_eq!(words(false, false), as_words("fn f() { { g(5); } g(6); } fn g(n: u32) {}"));
    }

    /// Files of WGSL below a folder of the repository: name without ending, and text. Those with `$` are parts of passes that Rust fills in yet.
    fn files(folder: &Path, found: &mut Vec<(String, String)>) {
        for entry in std::fs::read_dir(folder).unwrap().map(Result::unwrap) {
            let path = entry.path();
            if path.is_dir() {
                files(&path, found);
            } else if path.extension().is_some_and(|kind| kind == "wgsl") {
                let text =
                    std::fs::read_to_string(&path).unwrap().replace("$MASS", "node.w").replace("$STAY_AWAKE", "");
                found.push((path.file_stem().unwrap().to_string_lossy().into_owned(), text));
            }
        }
    }

    /// The text with all of its conditions met, or none.
    fn chosen_with(text: &str, are_met: bool) -> String {
        let (mut names, mut rest) = (Vec::new(), text);
        while let Some((_, attribute, behind)) = next_attribute(rest) {
            rest = behind;
            if attribute != "@else" {
                let words = in_parentheses(behind).0.split(|c: char| !c.is_alphanumeric() && c != '_');
                names.extend(words.filter(|word| !word.is_empty()).map(|word| (word, are_met)));
            }
        }
        chosen(text, &names)
    }

    /// The declarations of a text, by name; entries of passes, which nobody calls, are none.
    fn declarations(text: &str) -> Vec<(String, String)> {
        let (mut found, mut rest) = (Vec::new(), text.trim_start());
        while !rest.is_empty() {
            if rest.starts_with("//") {
                rest = rest.split_once('\n').map_or("", |(_, rest)| rest).trim_start();
                continue;
            }
            let (declaration, after) = rest.split_at(length_of_node(rest));
            rest = after.trim_start();
            let words: Vec<&str> =
                declaration.split(|c: char| !c.is_alphanumeric() && c != '_').filter(|word| !word.is_empty()).collect();
            let kind = words.iter().position(|word| ["fn", "const", "struct", "alias", "var"].contains(word));
            let name = kind.map(|at| match words[at] {
                "var" => declaration.split_once('>').unwrap().1.split(':').next().unwrap().trim(),
                _ => words[at + 1],
            });
            found.extend(
                name.filter(|_| !declaration.starts_with("@compute"))
                    .map(|name| (name.to_owned(), declaration.to_owned())),
            );
        }
        found
    }

    /// Symptom guarded against: a file that is WGSL only once Rust has put text into it, which no tool can read and nobody can follow. What a file
    /// uses of others is looked up there, else in stand-ins for what Rust writes.
    #[test]
    fn each_file_is_wgsl_by_itself() {
        let crates = Path::new(env!("CARGO_MANIFEST_DIR"));
        let mut all = vec![("prelude".to_owned(), include_str!("../prelude.wgsl").to_owned())];
        files(&crates.join("src/wgsl"), &mut all);
        files(&crates.join("../../grid-hier/src"), &mut all);
        files(&crates.join("../../sim-core/src"), &mut all);
        all.sort();
        // A part of a function, to be put into another one.
        all.retain(|(name, _)| name != "answer_awake");
        assert!(all.len() > 90, "{} files", all.len());
        let stand_ins = ("stand_ins".to_owned(), include_str!("stand_ins.wgsl").to_owned());
        let mut known: BTreeMap<String, Vec<(&str, String)>> = BTreeMap::new();
        for (file, text) in [&stand_ins].into_iter().chain(&all) {
            for (name, declaration) in declarations(&chosen_with(text, true)) {
                known.entry(name).or_default().push((file, declaration));
            }
        }
        for ((file, text), are_met) in all.iter().flat_map(|one| [(one, false), (one, true)]) {
            // Where several files declare a name, those that stand in a pass with this one go first.
            let mut beside = match file.as_str() {
                "grid" => vec!["watch_grid", "mirrored"],
                "p2g" => vec!["watch_p2g"],
                "g2p" => vec!["watch_g2p"],
                "restrict" => vec!["rim_sums", "grid", "hand_on"],
                "velocities" => vec!["grid"],
                "rims" | "rims_alone" => vec!["prolong", "solve"],
                "solve" => vec!["prolong"],
                "answer" | "group" => vec!["answering", "group"],
                "answer_alone" | "answer_and_rims" => vec!["answer", "answering", "group", "solve"],
                "list" => vec!["sort"],
                name if name.starts_with("sort_") => vec!["sort"],
                _ => Vec::new(),
            };
            let own = chosen_with(text, are_met);
            let declared = declarations(&own);
            // As every pass begins.
            let first = known.iter().filter(|(name, places)| {
                let (from, declaration) = &places[0];
                let is_shared = *from == "common" || *from == stand_ins.0;
                let is_plain = ["const", "struct"].iter().any(|kind| declaration.starts_with(kind));
                let is_used = is_shared && is_plain
                    || ["extent", "step", "layers", "status", "layer_now"].contains(&name.as_str());
                is_used && declared.iter().all(|(own, _)| own != *name)
            });
            let mut text = first.map(|(_, places)| places[0].1.clone() + "\n").collect::<String>() + &own;
            loop {
                // WGSL has a function of this name, too.
                let is_ours = text.contains("reflect(") && !text.contains("fn reflect(");
                let lacks = match parse_str(&text) {
                    _ if is_ours => "reflect".to_owned(),
                    Ok(_) => break,
                    Err(error) => {
                        let said = error.emit_to_string(&text);
                        let name = said.split("no definition in scope for identifier: `").nth(1);
                        let name = name.and_then(|rest| rest.split('`').next());
                        name.unwrap_or_else(|| panic!("{file}.wgsl, conditions {are_met}: {said}")).to_owned()
                    }
                };
                let places = known.get(&lacks).unwrap_or_else(|| panic!("{file}.wgsl: nobody declares {lacks}"));
                let (from, declaration) =
                    beside.iter().find_map(|file| places.iter().find(|(from, _)| from == file)).unwrap_or(&places[0]);
                if *from != stand_ins.0 && !beside.contains(from) {
                    beside.push(from);
                }
                // Some buffers are atomic to some passes only.
                let is_atomic =
                    ["Load", "Or", "Store", "Add"].iter().any(|call| text.contains(&format!("atomic{call}(&{lacks}[")));
                let declaration = if is_atomic {
                    declaration.replace("array<u32>", "array<atomic<u32>>")
                } else {
                    declaration.clone()
                };
                text = format!("{declaration}\n{text}");
            }
        }
    }
}
