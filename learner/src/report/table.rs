//! Tables for people, aligned for a terminal or as Markdown.

use std::fmt::Alignment::{self, Left, Right};
use std::fmt::Write;

/// How a report is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Style {
    /// For a terminal.
    Text,
    /// For a document.
    Markdown,
}

/// A table: how each column is aligned, and rows of cells, of which the first is the header.
pub struct Table {
    columns: Vec<Alignment>,
    rows: Vec<Vec<String>>,
}

impl Table {
    pub fn new(header: &[(&str, Alignment)]) -> Self {
        let columns = header.iter().map(|(_, alignment)| *alignment).collect();
        Self { columns, rows: vec![header.iter().map(|(name, _)| (*name).to_owned()).collect()] }
    }

    /// A row has a cell for each column.
    pub fn push(&mut self, row: impl Into<Vec<String>>) {
        self.rows.push(row.into());
    }

    pub fn render(&self, style: Style) -> String {
        let width = |column: usize| self.rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
        let widths: Vec<usize> = (0..self.columns.len()).map(width).collect();
        let mut text = String::new();
        for (index, row) in self.rows.iter().enumerate() {
            let cells = row.iter().zip(&widths).zip(&self.columns).map(|((cell, width), alignment)| match alignment {
                Left => format!("{cell:<width$}"),
                _ => format!("{cell:>width$}"),
            });
            let cells: Vec<_> = cells.collect();
            // Writing to a string cannot fail.
            match style {
                Style::Text => writeln!(text, "{}", cells.join("  ").trim_end()).ok(),
                Style::Markdown => writeln!(text, "| {} |", cells.join(" | ")).ok(),
            };
            if index == 0 && style == Style::Markdown {
                let rule = self.columns.iter().map(|alignment| if *alignment == Right { "---:" } else { "---" });
                writeln!(text, "| {} |", Vec::from_iter(rule).join(" | ")).ok();
            }
        }
        text
    }
}

#[cfg(test)]
#[path = "../../tests/unit/report/table.rs"]
mod tests;
