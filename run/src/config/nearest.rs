//! What a user probably meant by a misspelled name.

/// `did you mean a, b? ` with up to three of the known names, the most similar first; nothing if
/// none is similar. A name is similar if few letters differ, or if the word is part of it.
pub fn did_you_mean<'a>(word: &str, known: impl IntoIterator<Item = &'a str>) -> String {
    let likeness = |name| (strsim::normalized_damerau_levenshtein(word, name), name);
    let mut similar: Vec<(f64, &str)> = known.into_iter().map(likeness).collect();
    similar.retain(|(likeness, name)| *likeness > 0.6 || name.contains(word));
    similar.sort_by(|a, b| b.0.total_cmp(&a.0));
    let names: Vec<&str> = similar.into_iter().take(3).map(|(_, name)| name).collect();
    if names.is_empty() { String::new() } else { format!("did you mean {}? ", names.join(", ")) }
}

#[cfg(test)]
mod tests;
