//! Tables for the terminal: columns of text, each as wide as its widest cell.

use std::fmt;

/// Space between columns.
const GAP: &str = "  ";

/// A table with a row of titles.
pub(super) struct Columns {
    /// Whether the column ends at its right edge, as numbers do.
    to_the_right: Vec<bool>,
    rows: Vec<Vec<String>>,
}

impl Columns {
    /// A table without rows. A title begins with `<` or `>`: to which side its column is aligned.
    pub(super) fn new(titles: &[&str]) -> Self {
        let to_the_right = titles.iter().map(|title| title.starts_with('>')).collect();
        let titles = titles.iter().map(|title| title.chars().skip(1).collect());
        Self { to_the_right, rows: vec![titles.collect()] }
    }

    /// Adds a row, with a cell for every title.
    pub(super) fn row(&mut self, cells: Vec<String>) {
        self.rows.push(cells);
    }
}

impl fmt::Display for Columns {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let width = |column: usize| {
            let cells = self.rows.iter().filter_map(|row| row.get(column));
            cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
        };
        let widths: Vec<usize> = (0..self.to_the_right.len()).map(width).collect();
        for (place, row) in self.rows.iter().enumerate() {
            let columns = row.iter().zip(&widths).zip(&self.to_the_right);
            let cells = columns.map(|((cell, width), to_the_right)| match to_the_right {
                true => format!("{cell:>width$}"),
                false => format!("{cell:<width$}"),
            });
            let line = cells.collect::<Vec<_>>().join(GAP);
            let end = if place + 1 < self.rows.len() { "\n" } else { "" };
            write!(f, "{}{end}", line.trim_end())?;
        }
        Ok(())
    }
}

/// A number, or a dash where it was not measured.
pub(super) fn number_or_dash(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "–".to_owned(), |value| format!("{value:.digits$}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_as_wide_as_their_widest_cell() {
        let mut columns = Columns::new(&["<policy", ">dB", "<"]);
        columns.row(["a", "1.25", ""].map(String::from).to_vec());
        columns.row(["–", "10.5", "why"].map(String::from).to_vec());
        assert_eq!(columns.to_string(), "policy    dB\na       1.25\n–       10.5  why");
    }
}
