//! WGSL word by word, for texts of plugins: what they declare, and the same text under other names.

/// A piece of a text: a word, or what stands between words.
enum Piece<'a> {
    Word(&'a str),
    Between(&'a str),
}

/// The pieces of a text, each with how many braces are open there, and its line from 1. Comments are between words.
fn pieces(wgsl: &str) -> Vec<(Piece<'_>, usize, usize)> {
    let mut all = Vec::new();
    let (mut line, mut braces, mut block) = (1, 0usize, 0usize);
    let mut rest = wgsl;
    while let Some(c) = rest.chars().next() {
        let word = rest.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(rest.len());
        let (taken, is_word) = match c {
            _ if rest.starts_with("/*") => {
                block += 1;
                (2, false)
            }
            _ if block > 0 && rest.starts_with("*/") => {
                block -= 1;
                (2, false)
            }
            _ if block > 0 => (c.len_utf8(), false),
            _ if rest.starts_with("//") => (rest.find('\n').unwrap_or(rest.len()), false),
            _ if word > 0 => (word, true),
            _ => (c.len_utf8(), false),
        };
        let text = &rest[..taken];
        match text {
            "{" if block == 0 => braces += 1,
            "}" if block == 0 => braces = braces.saturating_sub(1),
            _ => {}
        }
        all.push((if is_word { Piece::Word(text) } else { Piece::Between(text) }, braces, line));
        line += text.matches('\n').count();
        rest = &rest[taken..];
    }
    all
}

/// Words outside braces and comments, each with its line from 1.
pub(crate) fn words_at_module_scope(wgsl: &str) -> impl Iterator<Item = (usize, String)> {
    pieces(wgsl).into_iter().filter_map(|(piece, braces, line)| match piece {
        Piece::Word(word) if braces == 0 => Some((line, word.to_owned())),
        _ => None,
    })
}

/// The names of the functions, constants, types and variables that a text declares at module scope.
pub(crate) fn declared_names(wgsl: &str) -> Vec<String> {
    let words: Vec<String> = words_at_module_scope(wgsl).map(|(_, word)| word).collect();
    let declares = |words: &[String]| match words {
        // Between these there stands the address space.
        [word, _, name] if word == "var" => Some(name.clone()),
        [word, name, ..] if ["fn", "const", "struct", "alias"].contains(&word.as_str()) => Some(name.clone()),
        _ => None,
    };
    (0..words.len()).filter_map(|at| declares(&words[at..words.len().min(at + 3)])).collect()
}

/// The text with other names for some of its words, but for members of structures and components of vectors.
pub(crate) fn renamed(wgsl: &str, to: impl Fn(&str) -> Option<String>) -> String {
    let mut all = String::with_capacity(wgsl.len());
    let (mut in_struct, mut rest) = (false, wgsl);
    for (piece, braces, _) in pieces(wgsl) {
        let text = match piece {
            Piece::Word(text) | Piece::Between(text) => text,
        };
        rest = &rest[text.len()..];
        match piece {
            Piece::Word(word) => {
                in_struct = if braces == 0 { word == "struct" || in_struct } else { in_struct };
                let is_member = all.ends_with('.') || in_struct && braces > 0 && rest.trim_start().starts_with(':');
                let other = if is_member { None } else { to(word) };
                all += &other.unwrap_or_else(|| word.to_owned());
            }
            Piece::Between(text) => {
                in_struct &= !(text == "}" && braces == 0);
                all += text;
            }
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "var<workgroup> shared_sum: array<f32, 4>;\nvar<private> own: f32;\n// fn other() in a comment\n/* struct block {} */\nconst SIZE: u32 = 2u;\nstruct Place { x: f32, size: f32 }\n\
        fn half(v: f32) -> f32 { let other = v; return 0.5 * other; }\nfn coupling_distance(p: Place) -> f32 { return half(p.size) * f32(SIZE); }\n";

    #[test]
    fn what_a_text_declares_is_found_and_nothing_else() {
        assert_eq!(declared_names(TEXT), ["shared_sum", "own", "SIZE", "Place", "half", "coupling_distance"]);
    }

    #[test]
    fn names_are_changed_where_they_stand_as_words_and_nowhere_else() {
        let names = declared_names(TEXT);
        let other = renamed(TEXT, |word| names.iter().any(|name| name == word).then(|| format!("{word}_1")));
        assert!(other.contains("return half_1(p.size) * f32(SIZE_1);"), "{other}");
        assert!(other.contains("struct Place_1 { x: f32, size: f32 }") && other.contains("let other = v;"), "{other}");
        let members = "struct Own { own: f32, by: Own }\nfn f(a: Own) -> f32 { return own + a.own; }";
        let own = renamed(members, |word| (word == "own").then(|| "own_1".to_owned()));
        assert_eq!(own, members.replace("own + a", "own_1 + a"));
        assert!(other.starts_with("var<workgroup> shared_sum_1: array<f32, 4>;\nvar<private> own_1: f32;\n// fn other() in a comment\n/* struct block {} */\n"), "{other}");
    }
}
