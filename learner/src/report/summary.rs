//! The whole report: a table of each run, a summary over seeds, and the paper's figures beside it.

use std::fmt::Alignment::{Left, Right};
use std::path::PathBuf;

use serde::Serialize;

use super::published::{Published, Remark};
use super::run::RunReport;
use super::seeds::{self, GroupReport};
use super::selection::Select;
use super::spread::Spread;
use super::table::{Style, Table};

/// What `learner report` says.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// Which evaluations of a run count.
    pub select: Select,
    /// Each folder.
    pub runs: Vec<RunReport>,
    /// The folders summarised over seeds.
    pub groups: Vec<GroupReport>,
}

impl Report {
    /// Reads run folders.
    ///
    /// # Errors
    /// One of them holds no run, or a file that no learner writes.
    pub fn read(paths: &[PathBuf], select: Select) -> anyhow::Result<Self> {
        let runs: Vec<_> = paths.iter().map(|path| RunReport::read(path)).collect::<anyhow::Result<_>>()?;
        Ok(Self { groups: seeds::groups(&runs, select), runs, select })
    }

    /// A table of each run; with several runs the summary over seeds; for tasks of the paper, its figures.
    pub fn text(&self) -> String {
        let mut parts: Vec<_> = self.runs.iter().map(|run| self.table(run)).collect();
        parts.extend(self.select.warning().map(str::to_owned));
        if self.runs.len() > 1 {
            parts.push(self.over_seeds(Style::Text));
        }
        parts.extend(self.beside_the_paper(Style::Text));
        parts.join("\n")
    }

    /// The summary over seeds and the paper's figures as Markdown.
    pub fn markdown(&self) -> String {
        let mut parts: Vec<_> = self.select.warning().map(str::to_owned).into_iter().collect();
        parts.push(self.over_seeds(Style::Markdown));
        parts.extend(self.beside_the_paper(Style::Markdown));
        parts.join("\n")
    }

    fn table(&self, run: &RunReport) -> String {
        let best = run.best().filter(|_| self.select == Select::Best);
        let best = best.map(|best| {
            let (step, measure, mean) = (best.step, run.measure(), best.score.mean);
            format!("mean {measure} of the best evaluation, after {step} steps: {mean:.2}\n")
        });
        run.table() + &best.unwrap_or_default()
    }

    fn over_seeds(&self, style: Style) -> String {
        let scores: &[_] = match self.select {
            Select::Last => &["last 3", "last 5", "last 50000 steps"],
            Select::Best => &["best evaluation"],
        };
        let texts = ["task", "algorithm"].map(|name| (name, Left));
        let numbers = ["trained for", "seeds"].map(|name| (name, Right));
        let mut header = Vec::from_iter(texts.into_iter().chain(numbers));
        header.push(("scored in", Left));
        header.extend(scores.iter().map(|name| (*name, Right)));
        header.push(("what differs from other runs of the task and algorithm", Left));
        let mut table = Table::new(&header);
        let cell = |value: Option<Spread>| value.map_or_else(|| "-".to_owned(), Spread::text_of_both);
        for g in &self.groups {
            let measure = if g.normalised { "" } else { " (returns)" };
            let mut row = vec![
                g.task.clone(),
                g.agent.clone(),
                g.steps_in_words(),
                g.seeds.len().to_string() + &g.goals.map(|goals| format!(", {goals} goals")).unwrap_or_default(),
                format!("{}{measure}", g.scored_in),
            ];
            row.extend(match self.select {
                Select::Last => [g.mean_last_3, g.mean_last_5, g.mean_last_50000_steps].map(cell).to_vec(),
                Select::Best => vec![cell(g.best)],
            });
            row.push(g.differs.join(", "));
            table.push(row);
        }
        let title = "Over seeds: mean ± standard deviation of the runs, divided by n - 1 (in parentheses: by n).";
        let mut text = format!("{title}\n\n{}", table.render(style));
        for group in &self.groups {
            text.extend(group.unfinished.iter().map(|run| format!("\nNot complete: {run}.\n")));
            text.extend(group.left_out.iter().map(|run| format!("\nNot counted: {run}.\n")));
        }
        text
    }

    /// For each task of the paper: what these runs score, what is published, and how the protocols differ.
    fn beside_the_paper(&self, style: Style) -> Vec<String> {
        let mut tasks: Vec<&str> = Vec::new();
        for group in self.groups.iter().filter(|group| !group.published.is_empty()) {
            if !tasks.contains(&&*group.task) {
                tasks.push(&group.task);
            }
        }
        tasks.into_iter().map(|task| self.task(task, style)).collect()
    }

    fn task(&self, task: &str, style: Style) -> String {
        let groups = || self.groups.iter().filter(|group| group.task == task);
        let mut table = Table::new(&[
            (task, Left),
            ("score", Right),
            ("± by n", Right),
            ("± by n - 1", Right),
            ("what stands behind it", Left),
        ]);
        let mut notes = String::from(
            "\nThe paper does not say how its ± is computed. DAC's code, on which its own is built, divides by the number of \
             seeds n.\n",
        );
        let published = groups().next().map_or(&[][..], |group| &group.published);
        // As wide as the letters beside the paper's figures.
        let width = published.iter().map(|published| published.remarks.len()).max().unwrap_or(0);
        let number = |value: Option<f64>| value.map(|value| format!("{value:.2}")).unwrap_or_default();
        for g in groups() {
            let ours = format!("ours: {}", g.named());
            let mut row = |score: Option<Spread>, what: &str| {
                let [mean, by_n, by_one_less] =
                    [score.map(|s| s.mean), score.and_then(|s| s.population_std), score.and_then(|s| s.std)];
                let mean = mean.map_or_else(|| "-".to_owned(), |mean| number(Some(mean)));
                let behind = format!("{what}; {}", g.behind());
                table.push([ours.clone(), format!("{mean} {:width$}", ""), number(by_n), number(by_one_less), behind]);
            };
            match self.select {
                Select::Last => row(g.mean_last_5, "last 5 evaluations"),
                Select::Best => row(g.best, "best evaluation of each run"),
            }
            if self.select == Select::Last
                && g.mean_last_50000_steps.is_some()
                && g.mean_last_50000_steps != g.mean_last_5
            {
                row(g.mean_last_50000_steps, "last 50000 steps");
            }
            if !g.departures.is_empty() {
                let departures = g.departures.join("; ");
                notes += &format!("\nNot the paper's protocol ({ours}, {} steps): {departures}.\n", g.steps);
            }
            if let Some(goals) = g.goals {
                notes += &format!(
                    "\nAntMaze-v0 has one goal a run: {goals} behind this ± ({ours}), where D4RL's code asks for 50 to 100 \
                     seeds.\n"
                );
            }
        }
        notes += &self.published(published, width, &mut table);
        table.render(style) + &notes
    }

    /// Adds the paper's figures to a table; gives the remarks on them, to which the letters beside the figures refer.
    fn published(&self, published: &[Published], width: usize, table: &mut Table) -> String {
        let mut remarks: Vec<&Remark> = Vec::new();
        for remark in published.iter().flat_map(|published| &published.remarks) {
            if !remarks.contains(&remark) {
                remarks.push(remark);
            }
        }
        let lettered = || remarks.iter().zip('a'..='z');
        for p in published {
            let printed = |value: f64| format!("{value:.1}");
            let letters = lettered().filter(|(remark, _)| p.remarks.contains(remark)).map(|(_, letter)| letter);
            let mean = format!("{} {:width$}", printed(p.score.mean), String::from_iter(letters));
            let std = p.score.std.map(printed).unwrap_or_default();
            table.push([p.method.to_owned(), mean, std, String::new(), p.source.to_owned()]);
        }
        let mut text = String::from(if remarks.is_empty() { "" } else { "\nOf the paper's figures:\n\n" });
        let with = |is_one: &dyn Fn(&Remark) -> bool| {
            let figures = published.iter().filter(|published| published.remarks.iter().any(is_one));
            Vec::from_iter(figures.map(|published| published.method)).join(", ")
        };
        for (remark, letter) in lettered() {
            let selected = if remark.selected { "selected by test returns: " } else { "" };
            text += &format!("- {letter} ({}): {selected}{}\n", with(&|other| other == *remark), remark.reason);
        }
        if self.select == Select::Best {
            let selected = with(&|remark| remark.selected);
            text += &format!(
                "\nOf the paper's figures, such selection stands behind those of {selected}, as far as is known.\n"
            );
        }
        text
    }
}
