//! Invariants of any world.

use quad_evaluator::serve::duty::Note;
use quad_learner::service::End;
use quad_protocol::{Hash, Job};

use crate::arithmetic::score;
use crate::world::World;

impl World {
    /// A new job has episodes that are not on the disk. No other evaluator plays them, but for one
    /// that is slow with an online episode.
    pub fn check_job(&mut self, job: &Job) -> Result<(), String> {
        let Some(alive) = &mut self.learner.alive else { return Ok(()) };
        if job.id <= alive.last_job {
            return Ok(());
        }
        alive.last_job = job.id;
        let (seed, online) = (job.seeds[0], job.exploration.is_some());
        let is_recorded = match online {
            true => alive.recorded.contains(&seed),
            false => job.seeds.iter().any(|&seed| self.disk.score(job.step, seed).is_some()),
        };
        let jobs = alive.service.connected().filter_map(|evaluator| evaluator.job);
        let is_same = |other: &Job| other.step == job.step && other.seeds.contains(&seed);
        let players = jobs.filter(|(other, _)| is_same(other)).count();
        match is_recorded || players > if online { 2 } else { 1 } {
            true => Err(format!("{job:?} is needless, with {players} players")),
            false => Ok(()),
        }
    }

    /// Results that the learner has acknowledged are on the disk from then on.
    pub fn noted(&mut self, number: usize, note: Note) -> Result<(), String> {
        let owed = &mut self.evaluators[number].owed;
        let mut settle = |step| {
            let index = owed.iter().position(|owed| *owed == step);
            index.map(|index| owed.swap_remove(index));
        };
        match note {
            Note::Scored(report, _) => {
                settle(report.step);
                let seeds = report.episodes.iter().map(|episode| (report.step, episode.seed));
                self.acknowledged_scores.extend(seeds);
            }
            Note::Experience { step, seed, .. } => {
                settle(step);
                self.acknowledged_episodes.insert(seed);
            }
            Note::Early { .. } => {}
            Note::Abandoned { step, reason } => {
                settle(step);
                self.record(|| format!("results of step {step} are abandoned: {reason}"));
                // Training has come to all that it needs.
                let needless = self.trained && reason.contains("no online episode");
                if reason.contains("refused") && !needless {
                    return Err(format!("results of step {step} are refused: {reason}"));
                }
            }
        }
        Ok(())
    }

    /// A snapshot has the weights of a run without faults, if all evaluators compute the same bits.
    pub fn check_snapshot(&self, step: u64, weights: Hash) -> Result<(), String> {
        let expected = self.reference.snapshots.get(&step);
        match self.settings.faults.other_bits || expected == Some(&weights) {
            true => Ok(()),
            false => Err(format!("the snapshot of step {step} depends on the schedule")),
        }
    }

    pub fn check_end(&mut self, end: End) -> Result<(), String> {
        match end {
            End::Complete => {}
            End::Unscored if self.deserted => return Ok(()),
            End::Unscored => return Err("the run has not waited for its evaluators".to_owned()),
            End::OtherWeights(error) => return Err(error.to_string()),
        }
        self.disk.check()?;
        for &(step, seed) in &self.acknowledged_scores {
            if self.disk.score(step, seed).is_none() {
                return Err(format!("the acknowledged score of step {step}, seed {seed} is lost"));
            }
        }
        let seeds = self.disk.online(&self.settings)?.seeds;
        for seed in &self.acknowledged_episodes {
            if !seeds.iter().any(|(recorded, hash)| recorded == seed && hash.is_some()) {
                return Err(format!("the acknowledged episode with seed {seed} is lost"));
            }
        }
        if !self.settings.faults.other_bits && self.last_state() != Some(self.reference.last) {
            return Err("the last state depends on the schedule".to_owned());
        }
        self.check_scores()
    }

    /// Every episode has its score, unless it was given up.
    fn check_scores(&self) -> Result<(), String> {
        let Some(alive) = &self.learner.alive else { return Ok(()) };
        let missing = alive.service.gauges().missing;
        let steps = self.settings.schedule.evaluations();
        let expected = steps as usize * self.settings.episodes as usize;
        if self.disk.scores.len() + missing != expected {
            let scores = self.disk.scores.len();
            return Err(format!("{scores} scores and {missing} given up are not {expected}"));
        }
        if missing == 0 && alive.evaluated.len() as u64 != steps {
            return Err(format!(
                "only the evaluations of steps {:?} are complete",
                alive.evaluated
            ));
        }
        if self.settings.faults.other_bits {
            return Ok(());
        }
        for line in &self.disk.scores {
            let weights = self.reference.snapshots[&line.step];
            if line.episode() != score(&weights, line.seed, 0) {
                return Err(format!("step {}, seed {} has another score", line.step, line.seed));
            }
        }
        Ok(())
    }
}
