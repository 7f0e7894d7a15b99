//! Tests of `report/lambda.rs`.

use serde_json::json;

use super::*;

/// Metrics of 20 lines in which λ is small in the first tenth and then as given, and a line that is not complete.
fn written(folder: &Path, lambda: impl Fn(u64) -> f64) {
    let line = |number: u64| {
        let lambda = if number <= 2 { 0.1 } else { lambda(number) };
        json!({
            "step": 100 * number, "seconds": 1.5, "bc_loss": 0.5, "lambda_mean": lambda, "lambda_fifth_2": 0.25,
            "lambda_quantile_10": 0.125, "lambda_above_99_share": 0.5, "variance_ratio": 2.0, "guidance_cosine": -0.5,
        })
    };
    let text = Vec::from_iter((1..=20).map(|number| line(number).to_string())).join("\n") + "\n{\"step\": 21";
    fs::write(folder.join("metrics.jsonl"), text).unwrap();
}

fn read(lambda: impl Fn(u64) -> f64) -> LambdaReport {
    let folder = tempfile::tempdir().unwrap();
    written(folder.path(), lambda);
    LambdaReport::read(folder.path(), "quad").unwrap().unwrap()
}

#[test]
fn a_run_whose_lambda_stays_near_one_is_called_dac() {
    let is_called_dac = |lambda: &LambdaReport| {
        let says = lambda.text("quad").contains("this run is DAC to within 1 %");
        assert_eq!(says, lambda.is_dac);
        says
    };
    let near = read(|_| 0.995);
    assert!(is_called_dac(&near) && !near.text("dac").contains("this run is"), "{}", near.text("dac"));
    assert!(!is_called_dac(&read(|number| if number == 11 { 0.98 } else { 1.0 })));
}

#[test]
fn lambda_is_summarised_after_the_first_tenth() {
    let lambda = read(|number| if number % 2 == 0 { 0.5 } else { 0.75 });
    for words in ["steps 201 to 2000: mean 0.625, of a batch 10 % below 0.125", "50.0 % above 0.99", " 0.250 "] {
        assert!(lambda.text("quad").contains(words), "{words} is missing in\n{}", lambda.text("quad"));
    }
    assert!(lambda.text("quad").contains("σ²/ν̂² 2.000, cosine of guidance and behaviour cloning -0.500"));
    let json = serde_json::to_value(&lambda).unwrap();
    assert_eq!((&json["from_step"], &json["to_step"], &json["is_dac"]), (&json!(201), &json!(2000), &json!(false)));
    assert!((json["lambda_mean"].as_f64().unwrap() - 0.625).abs() < 1e-12 && json.get("bc_loss").is_none(), "{json}");
}

#[test]
fn a_run_without_lambda_has_no_summary_of_it() {
    let folder = tempfile::tempdir().unwrap();
    assert_eq!(LambdaReport::read(folder.path(), "quad").unwrap(), None);
    fs::write(folder.path().join("metrics.jsonl"), "{\"step\":100,\"value_loss\":1.0}\n").unwrap();
    assert_eq!(LambdaReport::read(folder.path(), "iql").unwrap(), None);
    written(folder.path(), |_| 0.0);
    assert_eq!(LambdaReport::read(folder.path(), "none").unwrap(), None);
}
