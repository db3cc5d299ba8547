//! Tables in Markdown.

use std::fmt;

/// A table with a row of titles.
pub(super) struct MarkdownTable(String);

impl MarkdownTable {
    /// A table without rows; titles are separated by ` | `.
    pub(super) fn new(titles: &str) -> Self {
        Self(format!("| {titles} |\n|{}\n", "---|".repeat(titles.split(" | ").count())))
    }

    /// Adds a row, with a cell for every title.
    pub(super) fn row(&mut self, cells: &[String]) {
        self.0 += &format!("| {} |\n", cells.join(" | "));
    }
}

impl fmt::Display for MarkdownTable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A number, or a dash where it was not measured.
pub(super) fn number_or_dash(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "–".to_owned(), |value| format!("{value:.digits$}"))
}
