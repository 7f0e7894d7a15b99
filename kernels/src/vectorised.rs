//! Loops that are compiled for several instruction sets, of which the best is chosen at run time.

macro_rules! vectorised {
    ($(#[$meta:meta])* $vis:vis fn $name:ident($($arg:ident: $ty:ty),* $(,)?) $body:block) => {
        $(#[$meta])*
        #[multiversion::multiversion(targets(
            "x86_64+avx512f+avx512dq+avx512vl+avx512bw+avx2+fma+bmi1+bmi2",
            "x86_64+avx2+fma+bmi1+bmi2",
        ))]
        $vis fn $name($($arg: $ty),*) $body
    };
}

pub(crate) use vectorised;
