//! The CPU's vector instructions in use: the widest, or fewer, to test and measure what other CPUs
//! run.

use std::env;
use std::io::{self, Write};
use std::sync::LazyLock;

const VARIABLE: &str = "QUAD_INSTRUCTIONS";

/// Instruction sets; each includes those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Level {
    /// The instructions of every CPU of the architecture.
    Plain,
    /// AVX2 and FMA: 8 numbers at a time.
    Avx2,
    /// AVX-512 (F, DQ, VL, BW): 16 numbers at a time.
    Avx512,
}

impl Level {
    /// Name in `scores.jsonl`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Plain if cfg!(target_arch = "x86_64") => "x86",
            Self::Plain => env::consts::ARCH,
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
        }
    }

    /// The widest set of this CPU.
    pub fn available() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            let has_avx2 = is_x86_feature_detected!("avx2")
                && is_x86_feature_detected!("fma")
                && is_x86_feature_detected!("bmi1")
                && is_x86_feature_detected!("bmi2");
            let has_avx512 = is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("avx512bw");
            match (has_avx2, has_avx512) {
                (true, true) => Self::Avx512,
                (true, false) => Self::Avx2,
                (false, _) => Self::Plain,
            }
        }
        #[cfg(not(target_arch = "x86_64"))]
        Self::Plain
    }

    /// The level of this process: the widest, or at most AVX2 with `QUAD_INSTRUCTIONS=avx2`. Writes
    /// to stderr that it ignores any other value.
    pub fn in_use() -> Self {
        static IN_USE: LazyLock<Level> = LazyLock::new(|| {
            let (available, only) = (Level::available(), Level::Avx2);
            match env::var_os(VARIABLE) {
                Some(asked) if asked == only.name() => available.min(only),
                Some(asked) if !asked.is_empty() => {
                    let name = only.name();
                    let text = format!("{VARIABLE} is {asked:?}, not {name}, and is ignored");
                    writeln!(io::stderr(), "{text}").ok();
                    available
                }
                _ => available,
            }
        });
        *IN_USE
    }
}
