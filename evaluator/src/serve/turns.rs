//! Whose turn it is, of several runs that want this evaluator's time.
//!
//! Runs whose jobs come to something share the time equally. Whether a run's jobs do is found out by spending time on it, which a
//! learner that never answers, or forges jobs, wastes. So runs whose last job came to nothing, or that have had none done
//! yet, get half of the time at most, all together: however many there are, the others get the other half.

use std::time::{Duration, Instant};

/// First and longest pause after a learner did not answer though it is connected, or its job came to nothing.
const BACK_OFF: [Duration; 2] = [Duration::from_millis(250), Duration::from_secs(5)];

/// What is known of one run.
#[derive(Clone, Debug)]
pub struct Standing {
    ready_at: Instant,
    back_off: Duration,
    used: Duration,
    proven: bool,
}

impl Standing {
    /// Of a run that nothing is known of.
    pub fn new(now: Instant) -> Standing {
        Standing { ready_at: now, back_off: BACK_OFF[0], used: Duration::ZERO, proven: false }
    }

    /// When its learner may be asked again.
    pub fn ready_at(&self) -> Instant {
        self.ready_at
    }

    /// Time that was spent on it, compared with others.
    pub fn used(&self) -> Duration {
        self.used
    }

    /// Gives up the claim to time that others had before it came.
    pub fn start_from(&mut self, used: Duration) {
        self.used = self.used.max(used);
    }

    /// Lets the learner be asked at once, because it is there again.
    pub fn wake(&mut self, now: Instant) {
        self.ready_at = now;
        self.back_off = BACK_OFF[0];
    }

    /// Lets the learner be asked at once, unless something went wrong with it before.
    pub fn nudge(&mut self, now: Instant) {
        if self.back_off == BACK_OFF[0] {
            self.ready_at = now;
        }
    }

    /// Its learner has no work now.
    pub fn rest_until(&mut self, then: Instant) {
        self.back_off = BACK_OFF[0];
        self.ready_at = then;
    }

    /// Its scores were delivered: it is worth the time that it takes, if they were `accepted`.
    pub fn delivered(&mut self, accepted: bool) {
        self.back_off = BACK_OFF[0];
        self.proven = accepted;
    }

    /// A turn came to nothing: the pause is longer each time.
    pub fn failed(&mut self, now: Instant) {
        self.proven = false;
        self.ready_at = now + self.back_off;
        self.back_off = (2 * self.back_off).min(BACK_OFF[1]);
    }
}

/// Hands out the turns.
#[derive(Debug)]
pub struct Turns {
    /// Until then, runs that have proven worth their time go before all others.
    proven_first_until: Instant,
}

impl Turns {
    /// Before the first turn.
    pub fn new(now: Instant) -> Turns {
        Turns { proven_first_until: now }
    }

    /// Whose turn it is, of these; `None` if all of them have to wait.
    pub fn next<'a, K>(&self, runs: impl Iterator<Item = (K, &'a Standing)>, now: Instant) -> Option<K> {
        let (proven, others): (Vec<_>, Vec<_>) =
            runs.filter(|(_, run)| run.ready_at <= now).partition(|(_, run)| run.proven);
        let proven = proven.into_iter().min_by_key(|(_, run)| run.used);
        let others = others.into_iter().min_by_key(|(_, run)| run.ready_at);
        let next = if now < self.proven_first_until { proven.or(others) } else { others.or(proven) };
        next.map(|(key, _)| key)
    }

    /// A turn of `run` has ended.
    pub fn over(&mut self, run: &mut Standing, began: Instant, now: Instant) {
        let took = now - began;
        run.used += took;
        // Behind those that have waited meanwhile.
        run.ready_at = run.ready_at.max(now);
        if !run.proven {
            self.proven_first_until = now + took;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What a run does with a turn that it gets.
    #[derive(Clone, Copy)]
    enum Nature {
        /// Its job takes so many seconds and is delivered.
        Works(u64),
        /// So many seconds come to nothing.
        Wastes(u64),
        /// It works for a second, but every hundredth time it does not answer.
        Stumbles,
        /// So many seconds go into a job whose scores it does not take.
        Refuses(u64),
        /// It says at once that there is nothing to do.
        Idles,
    }

    /// The share of an hour that each run gets, and when it first had a turn.
    fn hour(natures: &[Nature]) -> Vec<(f64, Option<u64>)> {
        let start = Instant::now();
        let (mut now, mut turns) = (start, Turns::new(start));
        let mut runs: Vec<_> = natures.iter().map(|nature| (*nature, Standing::new(start), 0, None)).collect();
        while now - start < Duration::from_secs(3600) {
            let Some(next) = turns.next(runs.iter().enumerate().map(|(index, run)| (index, &run.1)), now) else {
                now += Duration::from_millis(1);
                continue;
            };
            let (nature, standing, count, first) = &mut runs[next];
            first.get_or_insert((now - start).as_secs());
            *count += 1;
            let began = now;
            match *nature {
                Nature::Works(seconds) => {
                    now += Duration::from_secs(seconds);
                    standing.delivered(true);
                }
                Nature::Wastes(seconds) => {
                    now += Duration::from_secs(seconds);
                    standing.failed(now);
                }
                Nature::Refuses(seconds) => {
                    now += Duration::from_secs(seconds);
                    standing.delivered(false);
                }
                Nature::Stumbles if *count % 100 == 0 => {
                    now += Duration::from_secs(5);
                    standing.failed(now);
                }
                Nature::Stumbles => {
                    now += Duration::from_secs(1);
                    standing.delivered(true);
                }
                Nature::Idles => {
                    now += Duration::from_millis(1);
                    standing.rest_until(now + Duration::from_secs(1));
                }
            }
            turns.over(standing, began, now);
        }
        runs.iter().map(|(_, standing, _, first)| (standing.used.as_secs_f64() / 3600.0, *first)).collect()
    }

    #[test]
    fn short_and_endless_jobs_get_the_same_time() {
        let shares = hour(&[Nature::Works(1), Nature::Works(60), Nature::Idles]);
        assert!((0.48..0.52).contains(&shares[0].0) && (0.48..0.52).contains(&shares[1].0), "{shares:?}");
    }

    #[test]
    fn runs_that_waste_time_get_half_of_it_however_many_they_are() {
        for seconds in [5, 31] {
            let mut natures = vec![Nature::Wastes(seconds); 63];
            natures.push(Nature::Works(1));
            let shares = hour(&natures);
            let (share, first) = shares[63];
            let before = first.unwrap() as f64 / 3600.0;
            assert!(share > 0.47 * (1.0 - before), "{share} of the time, from second {first:?}");
            assert!(shares[..63].iter().all(|(share, _)| *share > 0.0), "none of them is forgotten");
        }
    }

    #[test]
    fn a_learner_that_stumbles_is_believed_again() {
        let mut natures = vec![Nature::Wastes(5); 20];
        natures.push(Nature::Stumbles);
        let share = hour(&natures)[20].0;
        assert!(share > 0.3, "{share}");
    }

    #[test]
    fn a_newcomer_gets_its_turn_among_many_that_waste_time() {
        let mut natures = vec![Nature::Works(1)];
        natures.extend([Nature::Wastes(5); 62]);
        natures.push(Nature::Works(1));
        let shares = hour(&natures);
        assert!(shares[63].1.unwrap() <= 2 * 5 * 64, "{:?}", shares[63]);
        assert!(shares[63].0 > 0.15, "{:?}", shares[63]);
    }

    #[test]
    fn whoever_refuses_what_it_asked_for_does_not_keep_out_a_newcomer() {
        let shares = hour(&[Nature::Refuses(5), Nature::Wastes(5), Nature::Works(1)]);
        assert!(shares[1].1.is_some() && shares[2].0 > 0.45, "{shares:?}");
    }

    #[test]
    fn nobody_waits_for_those_who_are_not_there() {
        let share = hour(&[Nature::Wastes(5)])[0].0;
        assert!(share > 0.48, "all but its pauses: {share}");
    }
}
