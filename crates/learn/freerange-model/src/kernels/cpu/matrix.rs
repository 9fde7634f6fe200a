//! Matrices inside slices, and their products.

use gemm::Parallelism;

/// A read-only matrix inside a slice: element (i, j) is `data[i * rows + j * columns]`.
#[derive(Clone, Copy)]
pub struct Matrix<'a> {
    pub data: &'a [f32],
    pub row_stride: usize,
    pub column_stride: usize,
}

impl<'a> Matrix<'a> {
    /// Row-major with this many values from one row to the next.
    pub fn rows(data: &'a [f32], row_stride: usize) -> Self {
        Self { data, row_stride, column_stride: 1 }
    }

    /// The transpose, without moving anything.
    pub fn transposed(self) -> Self {
        Self { row_stride: self.column_stride, column_stride: self.row_stride, ..self }
    }

    /// All but the first rows.
    pub fn below(self, first: usize) -> Self {
        Self { data: &self.data[first * self.row_stride..], ..self }
    }

    /// Whether `[rows, columns]` lie within the slice.
    pub fn holds(&self, rows: usize, columns: usize) -> bool {
        rows == 0 || columns == 0 || (rows - 1) * self.row_stride + (columns - 1) * self.column_stride < self.data.len()
    }
}

/// `out = (add ? out : 0) + scale a b`, where `a` is `[m, k]`, `b` `[k, n]` and `out` `[m, n]` with this row stride.
///
/// # Safety
/// `out` must be valid for writes of `m` rows of `n` values at that stride, and nothing else may touch those meanwhile.
pub unsafe fn matmul(
    [m, k, n]: [usize; 3],
    a: Matrix,
    b: Matrix,
    scale: f32,
    out: *mut f32,
    out_row_stride: usize,
    add: bool,
    parallelism: Parallelism,
) {
    assert!(a.holds(m, k) && b.holds(k, n), "matrix product out of bounds");
    // SAFETY: the operands were checked above; the caller vouches for `out`.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            out,
            1,
            out_row_stride as isize,
            add,
            a.data.as_ptr(),
            a.column_stride as isize,
            a.row_stride as isize,
            b.data.as_ptr(),
            b.column_stride as isize,
            b.row_stride as isize,
            1.0,
            scale,
            false,
            false,
            false,
            parallelism,
        );
    }
}
