//! Published scores beside ours, one row per task.

use std::fmt::Alignment::{Left, Right};

use quad_run::results::published::{self, Published, once_each};
use quad_run::results::{Select, Spread};
use quad_run::table::{Block, Table};

use super::groups::GroupReport;

type Score<'a> = (&'a str, &'a Published);

/// The published table of this name with footnotes, of the tasks that some of these runs are on;
/// nothing without such runs.
pub fn table(name: &str, groups: &[GroupReport], select: Select) -> Vec<Block> {
    let in_table =
        |group: &&GroupReport| published::tables(&group.named, &group.algorithm).contains(&name);
    let groups = Vec::from_iter(groups.iter().filter(in_table));
    if groups.is_empty() {
        return Vec::new();
    }
    let tasks = once_each(groups.iter().map(|group| &*group.task));
    let ours = once_each(groups.iter().map(|group| &*group.method));
    let mut scores: Vec<Score> = Vec::new();
    for task in &tasks {
        let Some(group) = groups.iter().find(|group| group.task == *task) else { continue };
        let published = group.published.iter();
        let in_table = published.filter(|score| score.tables.iter().any(|table| table == name));
        scores.extend(in_table.map(|score| (*task, score)));
    }
    let theirs = methods(scores.iter());
    let remarks = scores.iter().flat_map(|(_, score)| &score.remarks);
    let reasons = once_each(remarks.map(|remark| remark.reason));
    let mut notes = Footnotes { ours: Vec::new(), theirs: reasons };

    let mut header = vec![("task".to_owned(), Left)];
    header.extend(ours.iter().map(|method| (format!("ours: {method}"), Right)));
    header.extend(theirs.iter().map(|method| ((*method).to_owned(), Right)));
    let mut table = Table::new(&header);
    for task in tasks {
        let mut row = vec![task.to_owned()];
        for method in &ours {
            let has_row = |group: &&&GroupReport| group.task == task && group.method == *method;
            // Complete runs come first.
            let group = groups.iter().filter(has_row).min_by_key(|group| group.reached.is_some());
            row.push(group.map_or("-".to_owned(), |group| notes.ours(group)));
        }
        for method in &theirs {
            let is_cell = |(row, score): &&Score| *row == task && score.method == *method;
            let score = scores.iter().find(is_cell);
            row.push(score.map_or("-".to_owned(), |(_, score)| notes.theirs(score)));
        }
        table.push(row);
    }
    let last = published::final_evaluations(&groups[0].named);
    let score = match select {
        Select::Last => format!("the mean of its last {last} evaluations"),
        Select::Best => "its best evaluation".to_owned(),
    };
    let protocol = scores.first().map_or("", |(_, score)| score.protocol);
    let title = format!(
        "{name}. Ours: mean ± standard deviation over seeds, divided by n - 1 (in parentheses: by n); a run's score is {score}. \
         {protocol}\n"
    );
    let notes = notes.text(&scores, select);
    vec![Block::Text(title), Block::Table(table), Block::Text(notes)]
}

fn methods<'a>(scores: impl Iterator<Item = &'a Score<'a>>) -> Vec<&'static str> {
    once_each(scores.map(|(_, score)| score.method))
}

/// Footnotes of our scores, with numbers, and of theirs, with letters.
struct Footnotes {
    ours: Vec<String>,
    theirs: Vec<&'static str>,
}

impl Footnotes {
    /// The score of a group, with the number of its footnote.
    fn ours(&mut self, group: &GroupReport) -> String {
        let mut note = group.provenance();
        if !group.departures.is_empty() {
            let departures = group.departures.join("; ");
            note += &format!(". Not its authors' protocol: {departures}");
        }
        if let Some(goals) = group.goals {
            note += &format!(
                ". AntMaze-v0 has one goal a run: {goals} behind this ±, where D4RL's code asks for 50 to 100 seeds"
            );
        }
        let index = self.ours.iter().position(|other| *other == note);
        let index = index.unwrap_or_else(|| {
            self.ours.push(note);
            self.ours.len() - 1
        });
        let score = Spread::new(&group.scores).map_or("-".to_owned(), Spread::text_with_population);
        format!("{score} [{}]", index + 1)
    }

    fn lettered(&self) -> impl Iterator<Item = (char, &'static str)> {
        ('a'..='z').zip(self.theirs.iter().copied())
    }

    /// A score as published, with the letters of its remarks.
    fn theirs(&self, score: &Published) -> String {
        let mut text = format!("{:.1} ", score.score.mean);
        if let Some(std) = score.score.std {
            text += &format!("± {std:.1} ");
        }
        for (letter, reason) in self.lettered() {
            if score.remarks.iter().any(|remark| remark.reason == reason) {
                text.push(letter);
            }
        }
        text.trim_end().to_owned()
    }

    fn text(&self, scores: &[Score], select: Select) -> String {
        let mut text = String::new();
        for (number, note) in self.ours.iter().enumerate() {
            text += &format!("- [{}] {note}.\n", number + 1);
        }
        let mut sources = Vec::new();
        for source in once_each(scores.iter().map(|(_, score)| score.source)) {
            let methods = methods(scores.iter().filter(|(_, score)| score.source == source));
            sources.push(format!("{}: {source}", methods.join(", ")));
        }
        text += &format!("- Sources: {}.\n", sources.join("; "));
        for (letter, reason) in self.lettered() {
            let (mut on, mut instead, mut selected) = (Vec::new(), Vec::new(), "");
            for score @ (task, published) in scores {
                for remark in published.remarks.iter().filter(|remark| remark.reason == reason) {
                    on.push(score);
                    if remark.selected {
                        selected = "selected by test returns: ";
                    }
                    let in_task = |mean| format!(" {mean:.1} in {task}");
                    instead.extend(remark.instead.map(in_task));
                }
            }
            let (methods, instead) = (methods(on.into_iter()).join(", "), instead.join(","));
            text += &format!("- {letter} ({methods}): {selected}{reason}{instead}\n");
        }
        let is_selected = |(_, score): &&Score| score.remarks.iter().any(|remark| remark.selected);
        let selected = methods(scores.iter().filter(is_selected)).join(", ");
        if select == Select::Best && !selected.is_empty() {
            text += &format!(
                "- As far as is known, the figures of {selected} are selected like this.\n"
            );
        }
        text
    }
}
