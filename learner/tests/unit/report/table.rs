//! Tests of `report/table.rs`.

use super::*;

#[test]
fn columns_are_aligned_by_characters() {
    let mut table = Table::new(&[("a", Left), ("b", Right)]);
    table.push(["long".to_owned(), "1".to_owned()]);
    table.push(["x".to_owned(), "1 ± 2".to_owned()]);
    assert_eq!(table.render(Style::Text), "a         b\nlong      1\nx     1 ± 2\n");
    let markdown = "| a    |     b |\n| --- | ---: |\n| long |     1 |\n| x    | 1 ± 2 |\n";
    assert_eq!(table.render(Style::Markdown), markdown);
}
