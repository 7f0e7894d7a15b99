//! Tables for people, aligned for a terminal or as Markdown.

use std::fmt::Alignment::{self, Left, Right};
use std::fmt::Write;

use super::Spread;

/// How a report is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Style {
    /// For a terminal.
    Text,
    /// For a document.
    Markdown,
}

/// A table: how each column is aligned, and rows of cells, of which the first is the header.
pub(super) struct Table<const COLUMNS: usize> {
    columns: [Alignment; COLUMNS],
    rows: Vec<[String; COLUMNS]>,
}

impl<const COLUMNS: usize> Table<COLUMNS> {
    pub(super) fn new(header: [(&str, Alignment); COLUMNS]) -> Self {
        Self { columns: header.map(|(_, alignment)| alignment), rows: vec![header.map(|(name, _)| name.to_owned())] }
    }

    pub(super) fn push(&mut self, row: [String; COLUMNS]) {
        self.rows.push(row);
    }

    pub(super) fn render(&self, style: Style) -> String {
        let width = |column: usize| self.rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
        let widths: [usize; COLUMNS] = std::array::from_fn(width);
        let mut text = String::new();
        for (index, row) in self.rows.iter().enumerate() {
            let cells = row.iter().zip(widths).zip(self.columns).map(|((cell, width), alignment)| match alignment {
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
                let rule = self.columns.map(|alignment| if alignment == Right { "---:" } else { "---" });
                writeln!(text, "| {} |", rule.join(" | ")).ok();
            }
        }
        text
    }
}

/// `mean ± std` with so many digits after the point; a single value has no deviation.
pub(super) fn spread(Spread { mean, std }: Spread, digits: usize) -> String {
    match std {
        Some(std) => format!("{mean:.digits$} ± {std:.digits$}"),
        None => format!("{mean:.digits$}"),
    }
}

/// The same of what may be missing.
pub(super) fn cell(value: Option<Spread>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| spread(value, 2))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_aligned_by_characters() {
        let mut table = Table::new([("a", Left), ("b", Right)]);
        table.push(["long".to_owned(), "1".to_owned()]);
        table.push(["x".to_owned(), "1 ± 2".to_owned()]);
        assert_eq!(table.render(Style::Text), "a         b\nlong      1\nx     1 ± 2\n");
        let markdown = "| a    |     b |\n| --- | ---: |\n| long |     1 |\n| x    | 1 ± 2 |\n";
        assert_eq!(table.render(Style::Markdown), markdown);
    }
}
