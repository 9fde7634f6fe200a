//! Tiles of bf16 numbers and their products with f32 sums on the tile unit of Intel's processors (AMX).
//!
//! A tile is 16 rows of 64 bytes. One instruction adds to 16 x 16 sums the products of 16 rows of the left operand (each
//! 32 numbers deep) and 16 columns of the right one, which wants its numbers in pairs along the depth: row `q` holds
//! pair `q` of every column. Operands are rounded to nearest even while they are packed; numbers below f32's normal
//! range count as zero.
//!
//! An operand is packed as *strips* of 32 lines (rows of the left operand, columns of the right one), a strip as *steps*
//! of 32 numbers along the depth, a step as two tiles. Missing lines and numbers are zeros.

mod attention;
mod pack;
mod product;
#[cfg(test)]
mod tests;

use std::{arch::asm, cell::Cell, marker::PhantomData, sync::OnceLock};

pub use attention::{head_backward, head_forward};
pub use product::product;

/// Lines of a strip, and numbers of a step.
pub const SIDE: usize = 32;
/// Lines of a tile.
const LINES: usize = 16;

/// 16 rows of 64 bytes.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub struct Tile([u32; 256]);

impl Tile {
    pub const ZERO: Self = Self([0; 256]);
}

/// Whether this CPU has the unit, and the operating system lets this process use it.
pub fn available() -> bool {
    static AVAILABLE: OnceLock<bool> = OnceLock::new();
    *AVAILABLE.get_or_init(|| {
        let vectors = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512bf16");
        vectors && has_tiles() && permitted()
    })
}

/// What the processor says of itself: leaf 7's AMX-BF16 and AMX-TILE.
fn has_tiles() -> bool {
    use std::arch::x86_64::{__cpuid, __cpuid_count};
    const BITS: u32 = 1 << 22 | 1 << 24;
    __cpuid(0).eax >= 7 && __cpuid_count(7, 0).edx & BITS == BITS
}

/// Asks Linux for the tiles' state, which it gives to a process only on request.
fn permitted() -> bool {
    const ARCH_REQ_XCOMP_PERM: libc::c_long = 0x1023;
    const XFEATURE_XTILEDATA: libc::c_long = 18;
    // SAFETY: the call changes nothing but what this process may use; where it is unknown, it fails.
    unsafe { libc::syscall(libc::SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA) == 0 }
}

/// What a product is added to.
#[derive(Clone, Copy)]
pub enum Start<'a> {
    Zeros,
    /// What is there.
    Result,
    /// The same for every row, at least as long as the result is wide.
    Row(&'a [f32]),
}

/// Where a product goes: up to 32 rows of up to 32 columns, rows `stride` apart.
#[derive(Clone, Copy)]
pub struct Place {
    pub out: *mut f32,
    pub stride: usize,
    pub rows: usize,
    pub columns: usize,
}

/// This thread's tile registers, configured; released when dropped, so that switching threads does not save them.
pub struct Unit(PhantomData<*const ()>);

impl Unit {
    pub fn new() -> Self {
        assert!(available(), "no tile unit");
        #[repr(C, align(64))]
        struct Config {
            palette: u8,
            start_row: u8,
            reserved: [u8; 14],
            row_bytes: [u16; 16],
            rows: [u8; 16],
        }
        let mut config = Config { palette: 1, start_row: 0, reserved: [0; 14], row_bytes: [0; 16], rows: [0; 16] };
        config.row_bytes[..8].fill(64);
        config.rows[..8].fill(16);
        // SAFETY: the unit exists and the process may use it; nothing else in the program uses tile registers.
        unsafe { asm!("ldtilecfg [{}]", in(reg) &raw const config, options(nostack, readonly, preserves_flags)) };
        Self(PhantomData)
    }

    /// `place = start + left right` for one strip of each operand.
    ///
    /// # Safety
    /// `place` must be valid for writes of its rows and columns, for reads too if it is what to start from, and nothing
    /// else may touch those meanwhile.
    #[inline]
    pub unsafe fn multiply(&self, left: &[Tile], right: &[Tile], start: Start, place: Place) {
        assert!(left.len() == right.len() && left.len().is_multiple_of(2), "strips of the same depth");
        let Place { out, stride, rows, columns } = place;
        let (from, from_stride) = match start {
            Start::Zeros => (std::ptr::null(), 0),
            Start::Result => (out.cast_const(), stride),
            Start::Row(row) => {
                assert!(row.len() >= columns, "a start as wide as the result");
                (row.as_ptr(), 0)
            }
        };
        let (left, right, steps) = (left.as_ptr(), right.as_ptr(), left.len() / 2);
        if rows == SIDE && columns == SIDE {
            // SAFETY: the unit is configured; all of the block is valid, by the caller's promise or as checked.
            return unsafe { block(steps, left, right, from, from_stride, out, stride) };
        }
        // What is at an edge goes by way of a whole block.
        let mut whole = Block([0.0; SIDE * SIDE]);
        if !from.is_null() {
            for (i, row) in whole.0.chunks_exact_mut(SIDE).enumerate().take(rows) {
                // SAFETY: rows and columns that may be read.
                unsafe { std::ptr::copy_nonoverlapping(from.add(i * from_stride), row.as_mut_ptr(), columns) };
            }
        }
        // SAFETY: the unit is configured; the block is ours.
        unsafe { block(steps, left, right, whole.0.as_ptr(), SIDE, whole.0.as_mut_ptr(), SIDE) };
        for (i, row) in whole.0.chunks_exact(SIDE).enumerate().take(rows) {
            // SAFETY: rows and columns that may be written.
            unsafe { std::ptr::copy_nonoverlapping(row.as_ptr(), out.add(i * stride), columns) };
        }
    }
}

impl Drop for Unit {
    fn drop(&mut self) {
        // SAFETY: the unit exists; this thread's tiles are not used any more.
        unsafe { asm!("tilerelease", options(nostack, nomem, preserves_flags)) };
    }
}

#[repr(C, align(64))]
struct Block([f32; SIDE * SIDE]);

/// 32 x 32 results from one strip of each operand; `from` is what to start from, or null.
///
/// # Safety
/// The tiles must be configured, `left` and `right` valid for `2 steps` tiles, `from` and `out` for 32 rows of 32
/// numbers.
#[inline]
unsafe fn block(
    steps: usize,
    left: *const Tile,
    right: *const Tile,
    from: *const f32,
    from_stride: usize,
    out: *mut f32,
    stride: usize,
) {
    let size = size_of::<f32>();
    // SAFETY: by the caller's promise. Every register that is changed is named.
    unsafe {
        asm!(
            "test {from}, {from}",
            "jz 2f",
            "tileloadd tmm0, [{from} + {from_stride}*1]",
            "tileloadd tmm1, [{from} + {from_stride}*1 + 64]",
            "tileloadd tmm2, [{from_below} + {from_stride}*1]",
            "tileloadd tmm3, [{from_below} + {from_stride}*1 + 64]",
            "jmp 3f",
            "2:",
            "tilezero tmm0",
            "tilezero tmm1",
            "tilezero tmm2",
            "tilezero tmm3",
            "3:",
            "test {steps}, {steps}",
            "jz 5f",
            "4:",
            "tileloadd tmm6, [{right} + {row}*1]",
            "tileloadd tmm4, [{left} + {row}*1]",
            "tileloadd tmm7, [{right} + {row}*1 + 1024]",
            "tdpbf16ps tmm0, tmm4, tmm6",
            "tileloadd tmm5, [{left} + {row}*1 + 1024]",
            "tdpbf16ps tmm1, tmm4, tmm7",
            "tdpbf16ps tmm2, tmm5, tmm6",
            "tdpbf16ps tmm3, tmm5, tmm7",
            "add {left}, 2048",
            "add {right}, 2048",
            "dec {steps}",
            "jnz 4b",
            "5:",
            "tilestored [{out} + {stride}*1], tmm0",
            "tilestored [{out} + {stride}*1 + 64], tmm1",
            "tilestored [{below} + {stride}*1], tmm2",
            "tilestored [{below} + {stride}*1 + 64], tmm3",
            steps = inout(reg) steps => _,
            left = inout(reg) left => _,
            right = inout(reg) right => _,
            row = in(reg) 64usize,
            from = in(reg) from,
            from_below = in(reg) from.wrapping_add(LINES * from_stride),
            from_stride = in(reg) from_stride * size,
            out = in(reg) out,
            below = in(reg) out.wrapping_add(LINES * stride),
            stride = in(reg) stride * size,
            out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
            out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
            options(nostack),
        );
    }
}

/// Lends so many tiles of this thread's, with anything in them.
pub fn with_tiles<R>(n: usize, f: impl FnOnce(&mut [Tile]) -> R) -> R {
    thread_local!(static KEPT: Cell<Vec<Tile>> = const { Cell::new(Vec::new()) });
    let mut tiles = KEPT.take();
    if tiles.len() < n {
        tiles.resize(n, Tile::ZERO);
    }
    let result = f(&mut tiles[..n]);
    // While `f` waited for other threads, this one may have lent and kept others; the larger buffer stays.
    let other = KEPT.take();
    KEPT.set(if other.len() > tiles.len() { other } else { tiles });
    result
}
