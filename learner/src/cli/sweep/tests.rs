//! Tests of `cli/sweep.rs`.

use super::*;

#[test]
fn shards_have_each_run_once() {
    let shards = ["1/3", "2/3", "3/3"].map(|text| parse_shard(text).unwrap());
    for index in 0..20 {
        assert_eq!(shards.iter().filter(|shard| shard.has(index)).count(), 1, "{index}");
    }
    for wrong in ["0/3", "4/3", "1", "1/0", "a/b", "-1/3"] {
        assert!(parse_shard(wrong).unwrap_err().contains("2/3"), "{wrong}");
    }
}
