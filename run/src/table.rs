//! Tables and paragraphs: aligned for a terminal, or as LaTeX.

use std::fmt::Alignment::{self, Right};

use serde::Serialize;

/// Format of a report.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Style {
    Text,
    /// LaTeX with the package booktabs.
    Latex,
}

/// A paragraph or a table of a report.
#[derive(Serialize)]
#[serde(rename_all = "lowercase")]
#[allow(missing_docs)]
pub enum Block {
    Text(String),
    Table(Table),
}

impl Block {
    /// The block in a style.
    pub fn render(&self, style: Style) -> String {
        match (self, style) {
            (Self::Table(table), _) => table.render(style),
            (Self::Text(text), Style::Text) => text.clone(),
            (Self::Text(text), Style::Latex) => {
                text.lines().map(|line| format!("{}\n\n", latex(line))).collect()
            }
        }
    }
}

/// A column of a table of `T`s: its header, its alignment, and the text of a cell.
pub type Column<T> = (&'static str, Alignment, fn(&T) -> String);

/// A table. The first row is the header.
#[derive(Serialize)]
pub struct Table {
    /// Columns that are aligned to the right.
    right: Vec<bool>,
    rows: Vec<Vec<String>>,
}

impl Table {
    /// A table with this header and no rows.
    pub fn new<T: AsRef<str>>(header: &[(T, Alignment)]) -> Self {
        let names = header.iter().map(|(name, _)| name.as_ref().to_owned());
        let right = header.iter().map(|(_, alignment)| *alignment == Right);
        Self { right: right.collect(), rows: vec![names.collect()] }
    }

    /// A table with a row for each item.
    pub fn from_rows<T>(items: &[T], columns: &[Column<T>]) -> Self {
        let header = columns.iter().map(|(name, alignment, _)| (*name, *alignment));
        let mut table = Self::new(&Vec::from_iter(header));
        for item in items {
            table.push(Vec::from_iter(columns.iter().map(|(_, _, cell)| cell(item))));
        }
        table
    }

    /// Adds a row with a cell for each column. Control characters become spaces.
    pub fn push(&mut self, row: impl Into<Vec<String>>) {
        let cells = row.into().into_iter();
        self.rows.push(cells.map(|cell| cell.replace(char::is_control, " ")).collect());
    }

    /// The table as text.
    pub fn render(&self, style: Style) -> String {
        match style {
            Style::Text => self.lines(),
            Style::Latex => {
                let line = |row: &Vec<String>| {
                    let cells = Vec::from_iter(row.iter().map(|cell| latex(cell))).join(" & ");
                    // After the \\ of another row, these would be its options.
                    let is_option = cells.trim_start().starts_with(['[', '*']);
                    let guard = if is_option { "{}" } else { "" };
                    format!("{guard}{cells} \\\\\n")
                };
                let mut lines: Vec<String> = self.rows.iter().map(line).collect();
                lines.insert(1, "\\midrule\n".to_owned());
                let columns = self.right.iter().map(|right| if *right { 'r' } else { 'l' });
                let (columns, rows) = (String::from_iter(columns), lines.concat());
                format!(
                    "\\begin{{tabular}}{{{columns}}}\n\\toprule\n{rows}\\bottomrule\n\\end{{tabular}}\n"
                )
            }
        }
    }

    /// The rows, with cells as wide as their columns.
    fn lines(&self) -> String {
        let width = |column: usize| {
            let cells = self.rows.iter().map(|row| row[column].chars().count());
            cells.max().unwrap_or(0)
        };
        let widths: Vec<usize> = (0..self.right.len()).map(width).collect();
        let pad = |((cell, width), right): ((&String, &usize), &bool)| match right {
            false => format!("{cell:<width$}"),
            true => format!("{cell:>width$}"),
        };
        let line = |row: &Vec<String>| {
            let cells = Vec::from_iter(row.iter().zip(&widths).zip(&self.right).map(pad));
            format!("{}\n", cells.join("  ").trim_end())
        };
        self.rows.iter().map(line).collect()
    }
}

/// Escapes text for LaTeX, for any encoding of fonts.
fn latex(text: &str) -> String {
    let escaped = |c: char| match c {
        '&' | '%' | '$' | '#' | '_' | '{' | '}' => format!("\\{c}"),
        '\\' => "\\textbackslash{}".to_owned(),
        '~' => "\\textasciitilde{}".to_owned(),
        '^' => "\\textasciicircum{}".to_owned(),
        '<' | '>' => format!("${c}$"),
        '±' => "$\\pm$".to_owned(),
        '−' => "$-$".to_owned(),
        'α' => "$\\alpha$".to_owned(),
        'β' => "$\\beta$".to_owned(),
        'γ' => "$\\gamma$".to_owned(),
        other => other.to_string(),
    };
    text.chars().map(escaped).collect()
}

#[cfg(test)]
mod tests;
