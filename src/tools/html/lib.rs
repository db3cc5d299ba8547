//! HTML files that stand for themselves: they refer to nothing outside, and escape what they are told.
//!
//! Pictures are `data:` URIs, curves are SVG within the page, and a policy in its head forbids the browser to
//! fetch anything. Without scripts, everything is shown; with them, sliders move.

mod markdown;
mod picture;

use maud::{DOCTYPE, Markup, PreEscaped, html};

pub use markdown::from_markdown;
pub use picture::{Embedded, embed_file};

use densify_core::files;

const STYLE: &str = concat!(include_str!("palette.css"), include_str!("page.css"));
const SCRIPT: &str = include_str!("page.js");
/// What a browser may load for the page: what stands in it. Were something not escaped, it could not speak to
/// anybody.
const POLICY: &str = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; \
    script-src 'unsafe-inline'; base-uri 'none'; form-action 'none'";

/// A page with these parts.
pub fn page(title: &str, body: &Markup) -> String {
    let title = files::one_line(title);
    let whole = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta http-equiv="Content-Security-Policy" content=(POLICY);
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                meta name="generator" content=(concat!("densify ", env!("CARGO_PKG_VERSION")));
                title { (title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                main { (body) }
                script { (PreEscaped(SCRIPT)) }
            }
        }
    };
    whole.into_string()
}

/// A column of a table.
#[derive(Debug, Clone, Copy)]
pub enum Column<'a> {
    Text(&'a str),
    /// Numbers end at the right.
    Number(&'a str),
}

/// A table of text, with a cell of each row for every column.
pub fn table(columns: &[Column<'_>], rows: &[Vec<String>]) -> Markup {
    let class = |at: usize| match columns.get(at) {
        Some(Column::Number(_)) => Some("number"),
        _ => None,
    };
    let titles = columns.iter().map(|column| {
        let (Column::Text(title) | Column::Number(title)) = column;
        files::one_line(title)
    });
    let titles: Vec<Markup> = titles.map(|title| html! { (title) }).collect();
    let cell = |cell: &String| html! { (files::one_line(cell)) };
    let rows: Vec<Vec<Markup>> = rows.iter().map(|row| row.iter().map(cell).collect()).collect();
    table_of(&titles, &rows, class)
}

/// A table, with the class of each column.
fn table_of(
    titles: &[Markup],
    rows: &[Vec<Markup>],
    class: impl Fn(usize) -> Option<&'static str>,
) -> Markup {
    html! {
        // It scrolls by itself where it is wider than the page.
        div.wide tabindex="0" role="group" aria-label="table" {
            table {
                thead { tr {
                    @for (at, title) in titles.iter().enumerate() {
                        th scope="col" class=[class(at)] { (title) }
                    }
                } }
                tbody {
                    @for row in rows {
                        tr { @for (at, cell) in row.iter().enumerate() { td class=[class(at)] { (cell) } } }
                    }
                }
            }
        }
    }
}

/// An SVG that one of our plots wrote, as a part of the page.
///
/// # Panics
/// When it is none.
pub fn inline_svg(svg: &str, (width, height): (u32, u32), what: &str) -> Markup {
    // Its own head has a size in pixels, and a name space that HTML does not need.
    let (head, rest) = svg.split_once('>').expect("an SVG has a head");
    assert!(head.starts_with("<svg"), "{head} is no SVG");
    html! {
        (PreEscaped(format!("<svg viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"")))
        (files::one_line(what))
        (PreEscaped("\">"))
        (PreEscaped(rest))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_stays_text_and_nothing_is_referred_to() {
        let evil = "<script>alert(1)</script>\"'&\u{1b}";
        let rows = [vec![evil.to_owned(), "1".to_owned()]];
        let svg = "<svg width=\"9\" xmlns=\"http://www.w3.org/2000/svg\"><rect/></svg>";
        let body = html! {
            (table(&[Column::Text("<a"), Column::Number("b")], &rows))
            (inline_svg(svg, (9, 9), evil))
        };
        let text = page(evil, &body);
        assert_eq!(text.matches("<script>").count(), 1, "the page's own: {text}");
        assert_eq!(
            text.matches("&lt;script&gt;alert(1)&lt;/script&gt;&quot;").count(),
            3,
            "{text}"
        );
        assert!(!text.contains("http:") && !text.contains("https:") && !text.contains("url("));
        assert!(text.contains("<th scope=\"col\">&lt;a</th>"), "{text}");
        assert!(text.contains("<td class=\"number\">1</td>"), "{text}");
        assert!(text.contains("<svg viewBox=\"0 0 9 9\""), "{text}");
        assert!(!text.contains('\u{1b}') && text.contains("\\u{1b}"), "{text}");
    }
}
