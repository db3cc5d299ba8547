//! Tables, rendered as Markdown or as HTML.

use std::fmt;

use maud::{Markup, html};

use super::Text;

/// A column of a [`Table`].
#[derive(Debug, Clone)]
pub struct Column {
    title: Text,
    /// Aligned at the right in HTML.
    is_number: bool,
}

impl Column {
    /// A column of text.
    pub fn text(title: &str) -> Self {
        Self { title: title.into(), is_number: false }
    }

    /// A column of numbers, aligned at the right in HTML.
    pub fn number(title: &str) -> Self {
        Self { title: title.into(), is_number: true }
    }

    fn class(&self) -> Option<&'static str> {
        self.is_number.then_some("number")
    }
}

/// A table, rendered as Markdown by [`Display`](fmt::Display) and as HTML by [`Table::to_html`].
#[derive(Debug, Clone)]
pub struct Table {
    columns: Vec<Column>,
    rows: Vec<Vec<Text>>,
}

impl Table {
    /// A table without rows.
    pub fn new(columns: impl IntoIterator<Item = Column>) -> Self {
        Self { columns: columns.into_iter().collect(), rows: Vec::new() }
    }

    /// Adds a row with a cell for every column.
    pub fn row<T: Into<Text>>(&mut self, cells: impl IntoIterator<Item = T>) {
        self.rows.push(cells.into_iter().map(T::into).collect());
    }

    /// True if no row was added.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// The table as HTML. A table wider than the page has its own scroll bar.
    pub fn to_html(&self) -> Markup {
        html! {
            div.wide tabindex="0" role="group" aria-label="table" {
                table {
                    thead { tr {
                        @for column in &self.columns {
                            th scope="col" class=[column.class()] { (column.title.to_html()) }
                        }
                    } }
                    tbody {
                        @for row in &self.rows {
                            tr {
                                @for (cell, column) in row.iter().zip(&self.columns) {
                                    td class=[column.class()] { (cell.to_html()) }
                                }
                            }
                        }
                    }
                }
            }
        }
    }
}

impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let write_row = |f: &mut fmt::Formatter<'_>, cells: &mut dyn Iterator<Item = &Text>| {
            let cells: Vec<String> =
                cells.map(|cell| cell.to_string().replace('|', "\\|")).collect();
            writeln!(f, "| {} |", cells.join(" | "))
        };
        write_row(f, &mut self.columns.iter().map(|column| &column.title))?;
        writeln!(f, "|{}", "---|".repeat(self.columns.len()))?;
        self.rows.iter().try_for_each(|row| write_row(f, &mut row.iter()))
    }
}
