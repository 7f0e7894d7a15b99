//! `learner judge`: ranks policies by the data alone.

use quad_run::table::{Block, Style};

use crate::cli::JudgeArgs;
use crate::judge::{Budget, judge};

pub fn run(args: &JudgeArgs) -> anyhow::Result<()> {
    let JudgeArgs { policies, gamma, steps, seeds, json: as_json } = args;
    let ranking = judge(policies, *gamma, Budget { steps: *steps, seeds: *seeds })?;
    let text = |block: Block| block.render(Style::Text);
    super::show(*as_json, &ranking, || ranking.blocks().map(text).join("\n"))
}
