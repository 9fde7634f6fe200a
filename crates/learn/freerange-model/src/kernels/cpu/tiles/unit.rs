//! The tile unit of Intel's processors.

use std::arch::asm;

use super::{LINES, Tile};

/// Whether this CPU has the unit, and the operating system lets this process use it.
pub fn available() -> bool {
    has_tiles() && permitted()
}

/// What the processor says of itself: leaf 7's AMX-BF16 and AMX-TILE.
fn has_tiles() -> bool {
    use std::arch::x86_64::{__cpuid, __cpuid_count};
    const BITS: u32 = 1 << 22 | 1 << 24;
    __cpuid(0).eax >= 7 && __cpuid_count(7, 0).edx & BITS == BITS
}

/// Asks Linux for the tiles' state, which it gives to a process only on request.
#[cfg(target_os = "linux")]
fn permitted() -> bool {
    const ARCH_REQ_XCOMP_PERM: libc::c_long = 0x1023;
    const XFEATURE_XTILEDATA: libc::c_long = 18;
    // SAFETY: the call changes nothing but what this process may use; where it is unknown, it fails.
    unsafe { libc::syscall(libc::SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA) == 0 }
}

/// Nobody to ask.
#[cfg(not(target_os = "linux"))]
fn permitted() -> bool {
    false
}

/// Configures this thread's tile registers: eight tiles of 16 rows of 64 bytes. Only where [`available`].
pub fn configure() {
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
}

/// Gives this thread's tile registers up.
pub fn release() {
    // SAFETY: the unit exists; this thread's tiles are not used any more.
    unsafe { asm!("tilerelease", options(nostack, nomem, preserves_flags)) };
}

/// 32 x 32 results from one strip of each operand; `from` is what to start from, or null.
///
/// # Safety
/// The tiles must be configured, `left` and `right` valid for `2 steps` tiles, `from` and `out` for 32 rows of 32
/// numbers.
pub unsafe fn block(
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
