//! Messages to be mutated, by a test beside this folder and by the fuzzer in protocol/fuzz.

use quad_protocol::*;

fn name() -> Name {
    Name::new("some-name").unwrap()
}

/// One of each kind and variant, with all of its fields filled.
pub fn frames() -> Vec<Vec<u8>> {
    let text = || "hopper".to_owned();
    let file: Vec<u8> = (0..100).collect();
    let weights = Hash::of(&file);
    let episodes = vec![EpisodeScore { seed: 1, episode_return: 2.0, length: 3, score: 4.0 }; 3];
    let job = Job {
        id: 1,
        run: name(),
        incarnation: 2,
        step: 3,
        weights,
        environment: text(),
        environment_seed: 4,
        seeds: vec![1, 2, 3],
        progress_milliseconds: 300,
    };
    let progress = Progress {
        evaluator: name(),
        run: name(),
        incarnation: 2,
        job: 1,
        step: 3,
        episodes_done: 1,
        episodes_total: 3,
        steps_done: 100,
        environment_steps: 200,
        episodes: 7,
    };
    let environments = vec![text(), "walker2d".to_owned()];
    vec![
        encode(&Snapshot { run: name(), incarnation: 1, step: 2, hash: weights, file }).unwrap(),
        encode(&JobRequest::Claim { evaluator: name(), attempt: 9, environments }).unwrap(),
        encode(&JobRequest::HandBack { evaluator: name(), job: 1, failed: Some(text()) }).unwrap(),
        encode(&JobReply::Job(job)).unwrap(),
        encode(&JobReply::Wait { incarnation: 2, milliseconds: 10 }).unwrap(),
        encode(&JobReply::HandedBack { incarnation: 2, accepted: true }).unwrap(),
        encode(&ScoreReport {
            evaluator: name(),
            run: name(),
            incarnation: 1,
            job: 2,
            step: 3,
            weights,
            precision: name(),
            episodes,
        })
        .unwrap(),
        encode(&ScoreReply::Recorded { incarnation: 1, new: 2, duplicates: 3 }).unwrap(),
        encode(&ScoreReply::Refused { incarnation: 1, reason: text() }).unwrap(),
        encode(&progress).unwrap(),
    ]
}
