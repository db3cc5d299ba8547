//! The Markdown that `compare` and `trade` write, as HTML: headings, paragraphs, tables, pictures, code blocks,
//! bold and code within lines. Everything else is text.

use std::iter::Peekable;
use std::str::Lines;

use maud::{Markup, html};

use super::{page, table_of};
use densify_run::failure::Failure;

/// A page of a text, whose pictures `embed` turns into URIs.
pub fn from_markdown(
    text: &str,
    embed: &dyn Fn(&str) -> Result<String, Failure>,
) -> Result<String, Failure> {
    let mut title = "";
    let mut parts = Vec::new();
    let mut lines = text.lines().peekable();
    while let Some(line) = lines.next() {
        parts.push(if let Some(text) = line.strip_prefix("# ") {
            title = text;
            html! { h1 { (inline(text)) } }
        } else if let Some(text) = line.strip_prefix("## ") {
            html! { h2 { (inline(text)) } }
        } else if let Some(text) = line.strip_prefix("### ") {
            html! { h3 { (inline(text)) } }
        } else if line.starts_with("```") {
            code(&mut lines)
        } else if line.starts_with('|') {
            table(line, &mut lines)
        } else if let Some((caption, file)) = picture(line) {
            let uri = embed(file)?;
            html! { figure.plot { img src=(uri) alt=(caption); } }
        } else if line.is_empty() {
            continue;
        } else {
            html! { p { (inline(line)) } }
        });
    }
    Ok(page(title, &html! { @for part in &parts { (part) } }))
}

/// `![caption](file)` by itself on a line.
fn picture(line: &str) -> Option<(&str, &str)> {
    line.strip_prefix("![")?.strip_suffix(')')?.rsplit_once("](")
}

fn code(lines: &mut Peekable<Lines<'_>>) -> Markup {
    let code: Vec<&str> = lines.by_ref().take_while(|line| !line.starts_with("```")).collect();
    html! { pre tabindex="0" { code { (code.join("\n")) } } }
}

fn table(titles: &str, lines: &mut Peekable<Lines<'_>>) -> Markup {
    let cells = |line: &str| -> Vec<Markup> {
        let inner = line.trim_start_matches("| ").trim_end_matches(" |");
        inner.split(" | ").map(inline).collect()
    };
    let mut rows = Vec::new();
    while let Some(line) = lines.next_if(|line| line.starts_with('|')) {
        // The line below the titles says only that they are titles.
        if !line.starts_with("|---") {
            rows.push(cells(line));
        }
    }
    table_of(&cells(titles), &rows, |_| None)
}

/// Text with its bold and code.
fn inline(text: &str) -> Markup {
    // Every second part stands between two marks.
    let marked = |text: &str, mark: &str| -> Vec<(bool, String)> {
        let parts = text.split(mark).enumerate();
        parts.map(|(at, part)| (at % 2 == 1, part.to_owned())).collect()
    };
    html! {
        @for (is_code, part) in marked(text, "`") {
            @if is_code { code { (part) } } @else {
                @for (is_bold, part) in marked(&part, "**") {
                    @if is_bold { strong { (part) } } @else { (part) }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_studies_write_is_shown_and_escaped() {
        let text = "# A <title>\n\nText with `code <b>` and **bold**: <i>.\n\n## Part\n\n| a | b |\n|---|---|\n\
            | 1 | **2** |\n| <x> | – |\n\n### Small\n\n![a \"plot\"](plot.svg)\n\n```toml\nx = \"<\"\n\ny = 1\n```\n";
        let embed = |file: &str| Ok(format!("data:{file}"));
        let page = from_markdown(text, &embed).unwrap();
        for expected in [
            "<title>A &lt;title&gt;</title>",
            "<h1>A &lt;title&gt;</h1>",
            "<p>Text with <code>code &lt;b&gt;</code> and <strong>bold</strong>: &lt;i&gt;.</p>",
            "<h2>Part</h2>",
            "<th scope=\"col\">a</th><th scope=\"col\">b</th>",
            "<tr><td>1</td><td><strong>2</strong></td></tr><tr><td>&lt;x&gt;</td><td>–</td></tr>",
            "<h3>Small</h3>",
            "<img src=\"data:plot.svg\" alt=\"a &quot;plot&quot;\">",
            "<code>x = &quot;&lt;&quot;\n\ny = 1</code></pre>",
        ] {
            assert!(page.contains(expected), "{expected} is not in {page}");
        }
        assert!(!page.contains("---|") && !page.contains("```"), "{page}");
        let fails = |_: &str| Err(Failure::input("gone"));
        assert_eq!(from_markdown(text, &fails).unwrap_err().to_string(), "gone");
    }
}
