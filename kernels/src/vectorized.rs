//! Loops compiled for several instruction sets, chosen at run time.

macro_rules! vectorized {
    ($(#[$meta:meta])* $vis:vis fn $name:ident($($arg:ident: $ty:ty),* $(,)?) $(-> $result:ty)? $body:block) => {
        $(#[$meta])*
        $vis fn $name($($arg: $ty),*) $(-> $result)? {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512dq,avx512vl,avx512bw,avx2,fma,bmi1,bmi2")]
                fn avx512($($arg: $ty),*) $(-> $result)? $body

                #[target_feature(enable = "avx2,fma,bmi1,bmi2")]
                fn avx2($($arg: $ty),*) $(-> $result)? $body

                use crate::level::Level;
                match Level::in_use() {
                    // SAFETY: the CPU has what is in use.
                    Level::Avx512 => return unsafe { avx512($($arg),*) },
                    // SAFETY: the CPU has what is in use.
                    Level::Avx2 => return unsafe { avx2($($arg),*) },
                    Level::Plain => {}
                }
            }
            fn plain($($arg: $ty),*) $(-> $result)? $body
            plain($($arg),*)
        }
    };
}

pub(crate) use vectorized;
