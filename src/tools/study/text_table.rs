//! Tables for the terminal, with columns as wide as their widest cell.

use std::fmt;

/// Space between columns.
const GAP: &str = "  ";

/// A table with a row of titles.
pub(super) struct TextTable {
    /// Alignment of each column.
    is_right_aligned: Vec<bool>,
    rows: Vec<Vec<String>>,
}

impl TextTable {
    /// A table without rows. Each title begins with `<` or `>`, the alignment of its column.
    pub(super) fn new(titles: &[&str]) -> Self {
        let is_right_aligned = titles.iter().map(|title| title.starts_with('>')).collect();
        let titles = titles.iter().map(|title| title.chars().skip(1).collect());
        Self { is_right_aligned, rows: vec![titles.collect()] }
    }

    /// Adds a row with a cell for every column.
    pub(super) fn row(&mut self, cells: Vec<String>) {
        self.rows.push(cells);
    }
}

impl fmt::Display for TextTable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let width = |column: usize| {
            let cells = self.rows.iter().filter_map(|row| row.get(column));
            cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
        };
        let widths: Vec<usize> = (0..self.is_right_aligned.len()).map(width).collect();
        for (index, row) in self.rows.iter().enumerate() {
            let columns = row.iter().zip(&widths).zip(&self.is_right_aligned);
            let cells = columns.map(|((cell, width), is_right_aligned)| {
                if *is_right_aligned {
                    format!("{cell:>width$}")
                } else {
                    format!("{cell:<width$}")
                }
            });
            let line = cells.collect::<Vec<_>>().join(GAP);
            let end = if index + 1 < self.rows.len() { "\n" } else { "" };
            write!(f, "{}{end}", line.trim_end())?;
        }
        Ok(())
    }
}

/// Formats a number, or a dash if it is unknown.
pub(super) fn number_or_dash(value: Option<f64>, digits: usize) -> String {
    or_dash(value.map(|value| format!("{value:.digits$}")))
}

/// The text, or a dash if there is none.
pub(super) fn or_dash(text: Option<String>) -> String {
    text.unwrap_or_else(|| "–".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_as_wide_as_their_widest_cell() {
        let mut table = TextTable::new(&["<policy", ">dB", "<"]);
        table.row(["a", "1.25", ""].map(String::from).to_vec());
        table.row(["–", "10.5", "why"].map(String::from).to_vec());
        assert_eq!(table.to_string(), "policy    dB\na       1.25\n–       10.5  why");
    }
}
