//! The product of rounded operands by AMX: whole tiles of 16 × 16 sums at a time.

use super::{COLUMNS, Pair, Strided, has_bf16};
use std::arch::asm;
use std::arch::x86_64::__cpuid_count;
use std::sync::LazyLock;

/// Rows of a tile, and registers of 16 numbers in it.
const TILE: usize = 16;
/// Rows of the result that are worked on together: two tiles above each other, beside two of
/// columns.
const ROWS: usize = 2 * TILE;

/// True if the CPU has AMX and the kernel grants this process its 8 KiB of registers.
pub(super) fn available() -> bool {
    static AVAILABLE: LazyLock<bool> = LazyLock::new(|| {
        const TILES_AND_BF16: u32 = 1 << 24 | 1 << 22;
        has_bf16() && __cpuid_count(7, 0).edx & TILES_AND_BF16 == TILES_AND_BF16 && may_use_tiles()
    });
    *AVAILABLE
}

/// Asks Linux, which grants it to the process for good.
#[cfg(target_os = "linux")]
fn may_use_tiles() -> bool {
    const ARCH_REQ_XCOMP_PERM: libc::c_int = 0x1023;
    const XFEATURE_XTILEDATA: libc::c_ulong = 18;
    // SAFETY: takes two numbers and changes nothing but the process's permission.
    unsafe { libc::syscall(libc::SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA) == 0 }
}

#[cfg(not(target_os = "linux"))]
fn may_use_tiles() -> bool {
    false
}

/// Operand of `ldtilecfg`: bytes per row and rows of each tile register.
#[repr(C, align(64))]
struct Configuration {
    palette: u8,
    start: u8,
    reserved: [u8; 14],
    row_bytes: [u16; 16],
    rows: [u8; 16],
}

impl Configuration {
    /// For sums of `upper` and `lower` rows: tiles 0 to 3 are the sums, 4 and 5 the rows of `a`, 6
    /// and 7 of `b`.
    fn new(upper: usize, lower: usize) -> Self {
        let (upper, lower, whole) = (upper as u8, lower as u8, TILE as u8);
        let (mut row_bytes, mut rows) = ([0; 16], [0; 16]);
        row_bytes[..8].fill(64);
        rows[..8].copy_from_slice(&[upper, upper, lower, lower, upper, lower, whole, whole]);
        Configuration { palette: 1, start: 0, reserved: [0; 14], row_bytes, rows }
    }
}

/// `c = a·b` for `m` rows and one block of columns, `b` being `pairs` × [`COLUMNS`].
///
/// # Safety
/// [`available`] must hold, `pairs` be a multiple of 16, and the three matrices must span that many
/// elements.
pub(super) unsafe fn panel(
    m: usize,
    pairs: usize,
    a: Strided<Pair>,
    b: *const Pair,
    c: *mut f32,
    c_row: usize,
) {
    // Blocks of nearly equal height, each of two halves of nearly equal height.
    let blocks = m.div_ceil(ROWS);
    let mut configured = (0, 0);
    for i in 0..blocks {
        let (from, to) = (i * m / blocks, (i + 1) * m / blocks);
        let upper = (to - from).div_ceil(2);
        // The halves of a single row are both this row.
        let lower = (to - from - upper).max(1);
        // SAFETY: rows from..to are inside, those of the lower half are the last of them.
        unsafe {
            if configured != (upper, lower) {
                configured = (upper, lower);
                let configuration = Configuration::new(upper, lower);
                asm!("ldtilecfg [{}]", in(reg) &raw const configuration, options(nostack, readonly));
            }
            block(
                pairs,
                [a.first.add(from * a.row), a.first.add((to - lower) * a.row)],
                a.row,
                b,
                [c.add(from * c_row), c.add((to - lower) * c_row)],
                c_row,
            );
        }
    }
    if blocks > 0 {
        // SAFETY: has no operands; what is left in the tiles is not needed.
        unsafe { asm!("tilerelease", options(nostack, nomem)) };
    }
}

/// Two by two tiles of the result.
///
/// # Safety
/// The tiles must be configured; `a` and `c` are the first rows of upper and lower half, with
/// distances `a_row` and `c_row` between rows in elements, and `b` is a block of `pairs` ×
/// [`COLUMNS`].
#[inline]
unsafe fn block(
    pairs: usize,
    a: [*const Pair; 2],
    a_row: usize,
    b: *const Pair,
    c: [*mut f32; 2],
    c_row: usize,
) {
    // SAFETY: reads and writes as many rows of 64 bytes as the configuration has, inside what the
    // caller vouches for.
    unsafe {
        asm!(
            "tilezero tmm0",
            "tilezero tmm1",
            "tilezero tmm2",
            "tilezero tmm3",
            "2:",
            "tileloadd tmm6, [{b} + {b_row}]",
            "tileloadd tmm4, [{upper} + {a_row}]",
            "tileloadd tmm7, [{b} + {b_row} + 64]",
            "tileloadd tmm5, [{lower} + {a_row}]",
            "tdpbf16ps tmm0, tmm4, tmm6",
            "tdpbf16ps tmm1, tmm4, tmm7",
            "tdpbf16ps tmm2, tmm5, tmm6",
            "tdpbf16ps tmm3, tmm5, tmm7",
            "add {upper}, 64",
            "add {lower}, 64",
            "add {b}, {b_step}",
            "dec {steps}",
            "jnz 2b",
            "tilestored [{c_upper} + {c_row}], tmm0",
            "tilestored [{c_upper} + {c_row} + 64], tmm1",
            "tilestored [{c_lower} + {c_row}], tmm2",
            "tilestored [{c_lower} + {c_row} + 64], tmm3",
            upper = inout(reg) a[0] => _,
            lower = inout(reg) a[1] => _,
            b = inout(reg) b => _,
            steps = inout(reg) pairs / TILE => _,
            a_row = in(reg) a_row * size_of::<Pair>(),
            b_row = in(reg) COLUMNS * size_of::<Pair>(),
            b_step = const TILE * COLUMNS * size_of::<Pair>(),
            c_upper = in(reg) c[0],
            c_lower = in(reg) c[1],
            c_row = in(reg) c_row * size_of::<f32>(),
            out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
            out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
            options(nostack),
        );
    }
}
