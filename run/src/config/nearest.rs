//! Suggestions for misspelled names.

/// `did you mean a, b? ` with up to three known names that contain the word or differ in few letters,
/// the most similar first; empty if there are none.
pub fn did_you_mean<'a>(word: &str, known: impl IntoIterator<Item = &'a str>) -> String {
    let likeness = |name| (strsim::normalized_damerau_levenshtein(word, name), name);
    let mut similar: Vec<(f64, &str)> = known.into_iter().map(likeness).collect();
    similar.retain(|(likeness, name)| *likeness > 0.6 || name.contains(word));
    similar.sort_by(|a, b| b.0.total_cmp(&a.0));
    let names: Vec<&str> = similar.into_iter().take(3).map(|(_, name)| name).collect();
    match names.is_empty() {
        true => String::new(),
        false => format!("did you mean {}? ", names.join(", ")),
    }
}
