//! Tests of `quad/summary.rs`.

use super::*;

/// Metrics of 20 lines in which λ is small in the first tenth and then as given.
fn lines(lambda: impl Fn(u64) -> f64) -> Vec<MetricsLine> {
    let line = |number: u64| {
        let lambda = if number <= 2 { 0.1 } else { lambda(number) };
        let line = json!({
            "step": 100 * number, "seconds": 1.5, "bc_loss": 0.5, "lambda_mean": lambda, "lambda_fifth_2": 0.25,
            "lambda_quantile_10": 0.125, "lambda_above_99_share": 0.5, "variance_ratio": 2.0, "guidance_cosine": -0.5,
        });
        serde_json::from_value(line).unwrap()
    };
    (1..=20).map(line).collect()
}

#[test]
fn a_run_whose_lambda_stays_near_one_is_called_dac() {
    let is_called_dac = |lines: &[MetricsLine], variant: &str| {
        let Summary { text, json, .. } = summarize(lines, variant).unwrap();
        let says = text.contains("this run is DAC to within 1 %");
        assert_eq!(says, json["is_dac"] == true && variant != "dac");
        says
    };
    let near = lines(|_| 0.995);
    assert!(is_called_dac(&near, "quad") && !is_called_dac(&near, "dac"));
    let dips = lines(|number| if number == 11 { 0.98 } else { 1.0 });
    assert!(!is_called_dac(&dips, "quad"));
}

#[test]
fn lambda_is_summarized_after_the_first_tenth() {
    let lines = lines(|number| if number % 2 == 0 { 0.5 } else { 0.75 });
    let Summary { text, json, .. } = summarize(&lines, "quad").unwrap();
    for words in [
        "steps 201 to 2000: mean 0.625, of a batch 10 % below 0.125",
        "50.0 % above 0.99",
        "t = 1…T: – 0.250 – – –\n",
        "σ²/ν̂² 2.000, cosine of guidance and behavior cloning -0.500",
    ] {
        assert!(text.contains(words), "{words} is missing in\n{text}");
    }
    assert_eq!([&json["from_step"], &json["to_step"]], [201, 2000]);
    assert!(json["is_dac"] == false && json.get("bc_loss").is_none(), "{json}");
    assert!((json["lambda_mean"].as_f64().unwrap() - 0.625).abs() < 1e-12);
}

#[test]
fn a_run_without_lambda_has_no_summary_of_it() {
    let line = MetricsLine::from([("step".to_owned(), 100.0), ("critic_loss".to_owned(), 1.0)]);
    assert_eq!(summarize(&[], "quad"), None);
    assert_eq!(summarize(&[line], "quad"), None);
    assert_eq!(summarize(&lines(|_| 0.0), "none"), None);
}
