//! Tables of published figures, with our runs beside them.

use std::fmt::Alignment::{Left, Right};

use quad_run::results::published::{self, Published, Remark, once_each};
use quad_run::results::{Select, Spread};
use quad_run::table::{Block, Table};

use super::seeds::GroupReport;

/// What is published for a task.
type Figure<'a> = (&'a str, &'a Published);

/// A table, in its rows the tasks that some of these runs have learned, with what stands behind
/// each figure below it; nothing without such runs.
pub fn table(name: &str, groups: &[GroupReport], select: Select) -> Vec<Block> {
    let is_in =
        |group: &&GroupReport| published::tables(&group.task, &group.algorithm).contains(&name);
    let groups: Vec<&GroupReport> = groups.iter().filter(is_in).collect();
    if groups.is_empty() {
        return Vec::new();
    }
    let tasks = once_each(groups.iter().map(|group| &*group.task));
    let ours = once_each(groups.iter().map(|group| &*group.method));
    let of_task = |task: &&str| {
        groups.iter().find(|group| group.task == *task).map(|group| (group, &group.published))
    };
    let figures = tasks
        .iter()
        .filter_map(of_task)
        .flat_map(|(group, all)| all.iter().map(|figure| (&*group.task, figure)));
    let figures: Vec<Figure> =
        figures.filter(|(_, figure)| figure.tables.iter().any(|table| table == name)).collect();
    let theirs = once_each(figures.iter().map(|(_, figure)| figure.method));
    let mut notes = Notes::of(&figures);

    let header = ours
        .iter()
        .map(|method| format!("ours: {method}"))
        .chain(theirs.iter().map(|m| (*m).to_owned()));
    let header =
        std::iter::once((String::from("task"), Left)).chain(header.map(|name| (name, Right)));
    let mut table = Table::new(&Vec::from_iter(header));
    for task in tasks {
        let mut row = vec![task.to_owned()];
        for method in &ours {
            let of_method = |group: &&&GroupReport| group.task == task && group.method == *method;
            // Complete runs come before those that are not.
            let group = groups.iter().filter(of_method).min_by_key(|group| group.reached.is_some());
            row.push(group.map_or_else(|| "-".to_owned(), |group| notes.ours(group)));
        }
        row.extend(theirs.iter().map(|method| {
            let figure =
                figures.iter().find(|(of, figure)| *of == task && figure.method == *method);
            figure.map_or_else(|| "-".to_owned(), |(_, figure)| notes.theirs(figure))
        }));
        table.push(row);
    }
    let score = match select {
        Select::Last => {
            format!("the mean of its last {} evaluations", published::last(&groups[0].task))
        }
        Select::Best => "its best evaluation".to_owned(),
    };
    let protocol = figures.first().map(|(_, figure)| figure.protocol).unwrap_or_default();
    let title = format!(
        "{name}. Ours: mean ± standard deviation over seeds, divided by n - 1 (in parentheses: by n); a run's score is {score}. \
         {protocol}\n"
    );
    vec![Block::Text(title), Block::Table(table), Block::Text(notes.text(&figures, select))]
}

/// What stands behind figures: of ours numbered, of others' with letters.
struct Notes {
    ours: Vec<String>,
    theirs: Vec<&'static str>,
}

impl Notes {
    fn of(figures: &[Figure]) -> Self {
        let reasons =
            figures.iter().flat_map(|(_, figure)| &figure.remarks).map(|remark| remark.reason);
        Self { ours: Vec::new(), theirs: once_each(reasons) }
    }

    /// A figure of ours, with the number of its note.
    fn ours(&mut self, group: &GroupReport) -> String {
        let mut note = group.behind();
        if !group.departures.is_empty() {
            note += &format!(". Not its authors' protocol: {}", group.departures.join("; "));
        }
        if let Some(goals) = group.goals {
            note += &format!(
                ". AntMaze-v0 has one goal a run: {goals} behind this ±, where D4RL's code asks for 50 to 100 seeds"
            );
        }
        let known = self.ours.iter().position(|other| *other == note);
        let index = known.unwrap_or_else(|| {
            self.ours.push(note);
            self.ours.len() - 1
        });
        let score = Spread::of(&group.scores).map_or_else(|| "-".to_owned(), Spread::text_of_both);
        format!("{score} [{}]", index + 1)
    }

    /// A figure as it is printed, with the letters of its remarks.
    fn theirs(&self, figure: &Published) -> String {
        let is_on = |reason: &str| figure.remarks.iter().any(|remark| remark.reason == reason);
        let letters = self
            .theirs
            .iter()
            .zip('a'..='z')
            .filter(|(reason, _)| is_on(reason))
            .map(|(_, letter)| letter);
        let letters = String::from_iter(letters);
        let std = figure.score.std.map(|std| format!(" ± {std:.1}")).unwrap_or_default();
        format!("{:.1}{std} {letters}", figure.score.mean).trim_end().to_owned()
    }

    /// All notes, a line each.
    fn text(&self, figures: &[Figure], select: Select) -> String {
        let numbered =
            self.ours.iter().zip(1..).map(|(note, number)| format!("- [{number}] {note}.\n"));
        let mut text = String::from_iter(numbered);
        let of_source = |source: &str| {
            let figures = figures.iter().filter(|(_, figure)| figure.source == source);
            format!("{}: {source}", once_each(figures.map(|(_, figure)| figure.method)).join(", "))
        };
        let sources = once_each(figures.iter().map(|(_, figure)| figure.source));
        text += &format!(
            "- Sources: {}.\n",
            sources.into_iter().map(of_source).collect::<Vec<_>>().join("; ")
        );
        for (reason, letter) in self.theirs.iter().zip('a'..='z') {
            let remark = |figure: &Published| {
                figure.remarks.iter().find(|remark| remark.reason == *reason).cloned()
            };
            let on: Vec<(&Figure, Remark)> =
                figures.iter().filter_map(|one| Some((one, remark(one.1)?))).collect();
            let methods = once_each(on.iter().map(|((_, figure), _)| figure.method)).join(", ");
            let selected = if on.iter().any(|(_, remark)| remark.selected) {
                "selected by test returns: "
            } else {
                ""
            };
            let instead = on.iter().filter_map(|((task, _), remark)| {
                Some(format!(" {:.1} in {task}", remark.instead?))
            });
            let instead = Vec::from_iter(instead).join(",");
            text += &format!("- {letter} ({methods}): {selected}{reason}{instead}\n");
        }
        let selected = figures
            .iter()
            .filter(|(_, figure)| figure.remarks.iter().any(|remark| remark.selected));
        let selected = once_each(selected.map(|(_, figure)| figure.method)).join(", ");
        if select == Select::Best {
            text += &format!(
                "- Of these figures, such selection stands behind those of {selected}, as far as is known.\n"
            );
        }
        text
    }
}
