//! Rust source without its comments, strings and unit tests: just enough of a lexer that a word
//! in a comment is not taken for code.

/// Whether string literals count as code.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Strings {
    /// They stay as they are.
    Keep,
    /// They become empty.
    Drop,
}

/// The text without comments and without the unit tests at its end; with or without the
/// contents of string literals.
pub(crate) fn code(text: &str, strings: Strings) -> String {
    let tests = text
        .match_indices("#[cfg(test)]")
        .find(|(at, mark)| text[at + mark.len()..].trim_start().starts_with("mod tests {"));
    let text = tests.map_or(text, |(at, _)| &text[..at]);
    let mut code = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        let skipped = comment_length(rest);
        if skipped > 0 {
            code.push(' ');
            rest = &rest[skipped..];
            continue;
        }
        let continues_word = code.ends_with(|c: char| c.is_alphanumeric() || c == '_');
        let length = if continues_word && first != '"' { 0 } else { literal_length(rest) };
        if length > 0 {
            match strings {
                Strings::Keep => code.push_str(&rest[..length]),
                Strings::Drop => code.push_str("\"\""),
            }
            rest = &rest[length..];
        } else {
            code.push(first);
            rest = &rest[first.len_utf8()..];
        }
    }
    code
}

/// Length of the comment that starts here, 0 if none does.
fn comment_length(text: &str) -> usize {
    if text.starts_with("//") {
        return text.find('\n').unwrap_or(text.len());
    }
    if !text.starts_with("/*") {
        return 0;
    }
    let (mut depth, mut at) = (0, 0);
    while at < text.len() {
        let here = &text.as_bytes()[at..];
        if here.starts_with(b"/*") {
            (depth, at) = (depth + 1, at + 2);
        } else if here.starts_with(b"*/") {
            (depth, at) = (depth - 1, at + 2);
            if depth == 0 {
                break;
            }
        } else {
            at += 1;
        }
    }
    at
}

/// Length of the string or character literal that starts here, 0 if none does.
fn literal_length(text: &str) -> usize {
    let bytes = text.as_bytes();
    let prefix = ["br", "cr", "b", "c", "r"]
        .into_iter()
        .find(|p| text.starts_with(p) && matches!(bytes.get(p.len()), Some(b'"' | b'#')));
    let start = prefix.map_or(0, str::len);
    if prefix.is_some_and(|p| p.ends_with('r')) {
        let hashes = bytes[start..].iter().take_while(|b| **b == b'#').count();
        if bytes.get(start + hashes) != Some(&b'"') {
            return 0; // A raw identifier.
        }
        let open = start + hashes + 1;
        let close = format!("\"{}", "#".repeat(hashes));
        return text[open..].find(&close).map_or(text.len(), |at| open + at + close.len());
    }
    match bytes.get(start) {
        Some(b'"') => {
            let mut at = start + 1;
            while at < bytes.len() && bytes[at] != b'"' {
                at += if bytes[at] == b'\\' { 2 } else { 1 };
            }
            (at + 1).min(bytes.len())
        }
        // A character; else it is a lifetime.
        Some(b'\'') if bytes.get(1) == Some(&b'\\') => {
            text[3..].find('\'').map_or(0, |at| 3 + at + 1)
        }
        Some(b'\'') => text[1..]
            .chars()
            .next()
            .map(char::len_utf8)
            .filter(|n| bytes.get(1 + n) == Some(&b'\''))
            .map_or(0, |n| n + 2),
        _ => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comments_strings_and_tests_are_no_code() {
        let text = r##"
            //! println! in a comment
            /* println! /* nested */ println! */
            fn f<'a>(x: &'a str) -> char {
                let s = "println! \" // not a comment";
                let r = r#"println! " "#;
                let c = ['"', '\'', '\n', '/', 'é'];
                let b = b"println!";
                write!(out, "{x}");
                'x'
            }
            #[cfg(test)]
            mod tests { fn t() { println!("allowed") } }
        "##;
        assert!(code(text, Strings::Keep).contains("println!"));
        let code = code(text, Strings::Drop);
        assert!(!code.contains("println!"), "{code}");
        assert!(code.contains("write!") && code.contains("fn f<'a>(x: &'a str)"), "{code}");
    }
}
