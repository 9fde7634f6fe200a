//! How this process holds its memory.

/// Keeps what is freed for what is allocated next, in large pages where the system has them. To be called once, before
/// there are other threads; without the GNU C library on Linux it does nothing.
///
/// Tensors of a training step are of some megabytes. By default such memory goes back to the system and comes again page by
/// page, and there are more small pages in a step than the processor remembers the places of.
pub fn keep_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: settings of the allocator, and a hint about its memory; what is read of the system are plain numbers.
    unsafe {
        libc::mallopt(libc::M_MMAP_MAX, 0);
        libc::mallopt(libc::M_TRIM_THRESHOLD, -1); // never
        // The hint is for addresses that there are already. This takes none of the memory itself.
        let (pages, size) = (libc::sysconf(libc::_SC_PHYS_PAGES), libc::sysconf(libc::_SC_PAGESIZE));
        let reserve = usize::try_from(pages * size).unwrap_or(0) / 2;
        let place = libc::malloc(reserve);
        if !place.is_null() {
            let first = place.addr().next_multiple_of(LARGEST_PAGE);
            libc::madvise(place.with_addr(first), reserve - (first - place.addr()), libc::MADV_HUGEPAGE);
            libc::free(place);
        }
    }
}

/// Large pages are of 2 MiB; addresses of a hint are whole small ones.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const LARGEST_PAGE: usize = 2 << 20;
