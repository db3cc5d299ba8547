//! A line of text with bold and code spans.

use std::fmt;

use maud::{Markup, html};

use densify_core::files;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Style {
    Plain,
    Bold,
    Code,
}

/// A line of text, rendered as Markdown by [`Display`](fmt::Display) and as HTML by [`Text::to_html`].
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Text(Vec<(Style, String)>);

impl Text {
    fn with(mut self, style: Style, text: &str) -> Self {
        self.0.push((style, files::one_line(text)));
        self
    }

    /// Appends plain text.
    pub fn plain(self, text: &str) -> Self {
        self.with(Style::Plain, text)
    }

    /// Appends bold text.
    pub fn bold(self, text: &str) -> Self {
        self.with(Style::Bold, text)
    }

    /// Appends code.
    pub fn code(self, text: &str) -> Self {
        self.with(Style::Code, text)
    }

    /// The text as HTML.
    pub fn to_html(&self) -> Markup {
        html! {
            @for (style, text) in &self.0 {
                @match style {
                    Style::Plain => { (text) }
                    Style::Bold => { strong { (text) } }
                    Style::Code => { code { (text) } }
                }
            }
        }
    }
}

impl From<&str> for Text {
    fn from(text: &str) -> Self {
        Self::default().plain(text)
    }
}

impl From<String> for Text {
    fn from(text: String) -> Self {
        Self::from(text.as_str())
    }
}

impl fmt::Display for Text {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|(style, text)| match style {
            Style::Plain => f.write_str(text),
            Style::Bold => write!(f, "**{text}**"),
            Style::Code => write!(f, "`{text}`"),
        })
    }
}
