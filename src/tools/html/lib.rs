//! Self-contained HTML pages, and tables and documents that are rendered as Markdown and as HTML.
//!
//! A page refers to nothing outside itself: pictures are `data:` URIs, plots are inline SVG, and a content security
//! policy forbids the browser to fetch anything. All text is escaped. Without scripts every picture is visible; scripts
//! add sliders.

mod document;
mod image;
mod table;
mod text;

use maud::{DOCTYPE, Markup, PreEscaped, html};

pub use document::Document;
pub use image::{EmbeddedImage, data_uri_of_file};
pub use table::{Column, Table};
pub use text::Text;

use densify_core::files;

/// The colours of all pages, light and dark, as CSS variables.
pub const PALETTE: &str = include_str!("palette.css");
const STYLE: &str = concat!(include_str!("palette.css"), include_str!("page.css"));
const SCRIPT: &str = include_str!("page.js");
/// Content security policy: the browser loads nothing but the page, so that even unescaped text could not send data.
const POLICY: &str = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; \
    script-src 'unsafe-inline'; base-uri 'none'; form-action 'none'";

/// An HTML page with this title and body.
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

/// Inlines the SVG of a plot into a page.
///
/// # Panics
/// If the text is not an SVG.
pub fn inline_svg(svg: &str, (width, height): (u32, u32), label: &str) -> Markup {
    // The start tag is replaced: it has a fixed size, and a namespace that HTML does not need.
    let (tag, rest) = svg.split_once('>').expect("an SVG has a start tag");
    assert!(tag.starts_with("<svg"), "{tag} is not an SVG");
    html! {
        (PreEscaped(format!("<svg viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"")))
        (files::one_line(label))
        (PreEscaped("\">"))
        (PreEscaped(rest))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_escaped_and_nothing_external_is_referenced() {
        let evil = "<script>alert(1)</script>\"'&\u{1b}";
        let mut table = Table::new([Column::text("<a"), Column::number("b")]);
        table.row([evil, "1"]);
        let svg = "<svg width=\"9\" xmlns=\"http://www.w3.org/2000/svg\"><rect/></svg>";
        let body = html! {
            (table.to_html())
            (inline_svg(svg, (9, 9), evil))
        };
        let text = page(evil, &body);
        assert_eq!(text.matches("<script>").count(), 1, "only the page's own script: {text}");
        let escaped = "&lt;script&gt;alert(1)&lt;/script&gt;&quot;";
        assert_eq!(text.matches(escaped).count(), 3, "{text}");
        assert!(!text.contains("http:") && !text.contains("https:") && !text.contains("url("));
        assert!(text.contains("<th scope=\"col\">&lt;a</th>"), "{text}");
        assert!(text.contains("<td class=\"number\">1</td>"), "{text}");
        assert!(text.contains("<svg viewBox=\"0 0 9 9\""), "{text}");
        assert!(!text.contains('\u{1b}') && text.contains("\\u{1b}"), "{text}");
    }
}
