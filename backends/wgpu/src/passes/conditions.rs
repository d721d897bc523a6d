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
}
