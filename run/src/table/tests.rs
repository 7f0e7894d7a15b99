//! Tests of tables.

use std::fmt::Alignment::Left;

use super::*;

#[test]
fn special_characters_are_escaped() {
    let mut table = Table::new(&[("a_b", Left), ("b", Right)]);
    table.push(["50 %, & more".to_owned(), "1 ± 2 \"x\"".to_owned()]);
    let latex = "\\begin{tabular}{lr}\n\\toprule\na\\_b & b \\\\\n\\midrule\n50 \\%, \\& more & 1 $\\pm$ 2 \"x\" \\\\\n\\bottomrule\n\\end{tabular}\n";
    assert_eq!(table.render(Style::Latex), latex);
    let words = Block::Text("±1 of a_b\nα and γ\n".to_owned());
    assert_eq!(words.render(Style::Latex), "$\\pm$1 of a\\_b\n\n$\\alpha$ and $\\gamma$\n\n");
}

/// Names of tasks and runs may be those of another user's files.
#[test]
fn names_do_not_break_tables() {
    for (name, text, latex) in [
        ("[2cm]", "[2cm]", "{}[2cm]"),
        ("*", "*", "{}*"),
        ("a\\b", "a\\b", "a\\textbackslash{}b"),
        ("<b>", "<b>", "$<$b$>$"),
        ("a\nb\u{1b}[2J", "a b [2J", "a b [2J"),
    ] {
        let mut table = Table::new(&[("task", Left)]);
        table.push([name.to_owned()]);
        for (style, cell) in
            [(Style::Text, text.to_owned()), (Style::Latex, format!("{latex} \\\\"))]
        {
            let rendered = table.render(style);
            let has = rendered.lines().any(|line| line == cell);
            assert!(has, "{cell:?} is missing in {rendered:?}");
        }
    }
}
