//! NCCL among processes: rank 0 draws an identifier, and all join under it, each with a card of its own.

use std::{
    fmt,
    mem::MaybeUninit,
    rc::Rc,
    sync::{Arc, OnceLock},
};

use burn::{
    backend::{Backend, Dispatch, Flex, backend_extension, tensor::FloatTensor},
    tensor::{DType, Device, Tensor},
};
use burn_cubecl::{CubeBackend, CubeDevice, kernel::into_contiguous, tensor::CubeTensor};
use cubecl::cuda::CudaRuntime;
use cubecl_runtime::runtime::Runtime;
use cudarc::{
    driver::{CudaContext, CudaStream},
    nccl::{result, sys},
};

use freerange_train::{
    TrainError,
    ranks::{AllReduceDtype, Ranks, agree, gather},
};

/// Ranks whose tensors on cards are summed by NCCL, without a copy to the host; all else goes the way of the ranks within.
pub struct Nccl {
    within: Rc<dyn Ranks>,
    group: Arc<Group>,
}

impl fmt::Debug for Nccl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Nccl").field("rank", &self.rank()).field("world", &self.world()).finish()
    }
}

impl Nccl {
    /// Joins the ranks' cards. All ranks have to call it.
    ///
    /// # Errors
    /// [`TrainError::Ranks`] where a device is no CUDA card, where two ranks of a machine have the same one (NCCL's own
    /// refusal), or where NCCL cannot be loaded; [`TrainError::Elsewhere`] where that is so of another rank.
    pub fn join(within: Rc<dyn Ranks>, device: &Device) -> Result<Self, TrainError> {
        let ready = || {
            let card = card(device)?;
            loaded()?;
            // The primary context, which CubeCL computes in, too; it becomes this thread's.
            let context = CudaContext::new(card).map_err(|e| failed("the card's context", &e))?;
            context.new_stream().map_err(|e| failed("a stream of its own", &e))
        };
        let stream = agree(&*within, ready())?;
        let drawn = match within.rank() {
            0 => result::get_uniqueid().map(|id| id.internal.map(|byte| byte as u8).to_vec()),
            _ => Ok(Vec::new()),
        };
        let drawn = agree(&*within, drawn.map_err(|e| nccl_failed("ncclGetUniqueId", &e)))?;
        let told = gather(&*within, &drawn)?.swap_remove(0);
        let mut id = sys::ncclUniqueId { internal: [0; 128] };
        id.internal.iter_mut().zip(&told).for_each(|(to, &from)| *to = from as _);
        let mut handle = MaybeUninit::uninit();
        let (world, rank) = (within.world() as i32, within.rank() as i32);
        // SAFETY: all ranks join under the identifier of rank 0 with a number of their own, and a context is current. The
        // handle is read only after success.
        let joined =
            unsafe { result::comm_init_rank(handle.as_mut_ptr(), world, id, rank).map(|_| handle.assume_init()) };
        let handle = agree(&*within, joined.map_err(|e| nccl_failed("ncclCommInitRank", &e)))?;
        Ok(Self { within, group: Arc::new(Group { handle, stream }) })
    }
}

impl Ranks for Nccl {
    fn rank(&self) -> usize {
        self.within.rank()
    }

    fn world(&self) -> usize {
        self.within.world()
    }

    /// In bf16 every hop rounds, where [`AllReduceDtype::Bf16`] elsewhere rounds twice.
    fn sum(&self, flat: Tensor<1>, dtype: AllReduceDtype) -> Result<Tensor<1>, TrainError> {
        if card(&flat.device()).is_err() {
            return self.within.sum(flat, dtype);
        }
        let sent = match dtype {
            AllReduceDtype::F32 => flat,
            AllReduceDtype::Bf16 => flat.cast(DType::BF16),
        };
        let error = Arc::new(OnceLock::new());
        let sum = Dispatch::sum_among(sent.into_dispatch(), self.group.clone(), error.clone());
        match error.get() {
            Some(problem) => Err(TrainError::Ranks { problem: String::clone(problem) }),
            None => Ok(Tensor::<1>::from_dispatch(sum).cast(DType::F32)),
        }
    }

    fn abort(&self, code: u8, why: &dyn fmt::Display) -> ! {
        self.within.abort(code, why)
    }
}

/// One process's place among the cards.
pub struct Group {
    handle: sys::ncclComm_t,
    stream: Arc<CudaStream>,
}

// SAFETY: NCCL wants one thread at a time for a communicator, not always the same; only `Nccl` has it, which stays with its thread.
unsafe impl Send for Group {}
// SAFETY: as above; `sum` is the only use.
unsafe impl Sync for Group {}

impl fmt::Debug for Group {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Group").finish_non_exhaustive()
    }
}

impl Group {
    /// The sum over all ranks' `flat`, in new memory; it is there when this returns.
    fn sum(&self, flat: CubeTensor) -> Result<CubeTensor, TrainError> {
        type Server = <CudaRuntime as Runtime>::Server;
        let flat = into_contiguous(flat);
        let (shape, count) = (flat.meta.shape().clone(), flat.meta.num_elements());
        let kind = match flat.dtype {
            DType::F32 => sys::ncclDataType_t::ncclFloat32,
            DType::BF16 => sys::ncclDataType_t::ncclBfloat16,
            other => return Err(TrainError::Ranks { problem: format!("NCCL: expected f32 or bf16, found {other:?}") }),
        };
        let sum = flat.client.empty(count * flat.elem_size());
        let place = |handle| flat.client.get_resource::<Server>(handle).map_err(|e| failed("the tensor's memory", &e));
        let (from, to) = (place(flat.handle.clone())?, place(sum.clone())?);
        // What fills the one has been queued elsewhere, and so has what the other's memory was used for before.
        cubecl::future::block_on(flat.client.sync()).map_err(|e| failed("what comes before the sum", &e))?;
        self.stream.context().bind_to_thread().map_err(|e| failed("the card's context", &e))?;
        // SAFETY: both are memory of the card, of `count` numbers of this kind, alive until the stream has been waited for.
        let begun = unsafe {
            result::all_reduce(
                from.resource().ptr as *const _,
                to.resource().ptr as *mut _,
                count,
                kind,
                sys::ncclRedOp_t::ncclSum,
                self.handle,
                self.stream.cu_stream().cast(),
            )
        };
        begun.map_err(|e| nccl_failed("ncclAllReduce", &e))?;
        self.stream.synchronize().map_err(|e| failed("the sum", &e))?;
        Ok(CubeTensor::new_contiguous(flat.client.clone(), flat.device.clone(), shape, sum, flat.dtype))
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        // SAFETY: joined once and not used any more. Where this rank fails alone, the others would be waited for.
        let _ = unsafe {
            match std::thread::panicking() {
                true => result::comm_abort(self.handle),
                false => result::comm_destroy(self.handle),
            }
        };
    }
}

/// The backends' part of [`Nccl`].
#[backend_extension(Flex, Cube: cfg(feature = "nccl"))]
trait SumAmong: Backend {
    /// `flat` itself, and the reason in `error`, where it cannot be summed.
    fn sum_among(flat: FloatTensor<Self>, group: Arc<Group>, error: Arc<OnceLock<String>>) -> FloatTensor<Self>;
    /// Number of the card that the tensor is on, in `found`.
    fn card_of(flat: FloatTensor<Self>, found: Arc<OnceLock<usize>>) -> FloatTensor<Self>;
}

impl SumAmong for Flex {
    fn sum_among(flat: FloatTensor<Self>, _: Arc<Group>, error: Arc<OnceLock<String>>) -> FloatTensor<Self> {
        error.get_or_init(|| "NCCL: expected a tensor on a card, found one on the CPU".into());
        flat
    }

    fn card_of(flat: FloatTensor<Self>, _: Arc<OnceLock<usize>>) -> FloatTensor<Self> {
        flat
    }
}

impl SumAmong for CubeBackend {
    fn sum_among(flat: CubeTensor, group: Arc<Group>, error: Arc<OnceLock<String>>) -> CubeTensor {
        group.sum(flat.clone()).unwrap_or_else(|e| {
            error.get_or_init(|| e.to_string());
            flat
        })
    }

    fn card_of(flat: CubeTensor, found: Arc<OnceLock<usize>>) -> CubeTensor {
        if let CubeDevice::Cuda(card) = &flat.device {
            found.get_or_init(|| card.index);
        }
        flat
    }
}

/// The number of the device's card, as CUDA counts.
fn card(device: &Device) -> Result<usize, TrainError> {
    let found = Arc::new(OnceLock::new());
    Dispatch::card_of(Tensor::<1>::zeros([1], &device.clone().inner()).into_dispatch(), found.clone());
    let problem =
        || TrainError::Ranks { problem: format!("NCCL: expected a CUDA device (--device cuda), found {device:?}") };
    found.get().copied().ok_or_else(problem)
}

/// Says where NCCL was looked for, if it is not there.
fn loaded() -> Result<(), TrainError> {
    // SAFETY: loads the library, whose initializers are NVIDIA's.
    if unsafe { sys::is_culib_present() } {
        return Ok(());
    }
    let names = cudarc::get_lib_name_candidates("nccl");
    let problem = format!(
        "NCCL: found none of {} where the loader looks (LD_LIBRARY_PATH); packages have libnccl.so.2: link libnccl.so to it",
        names.join(", ")
    );
    Err(TrainError::Ranks { problem })
}

fn failed(what: &str, e: &dyn fmt::Debug) -> TrainError {
    TrainError::Ranks { problem: format!("NCCL: {what}: {e:?}") }
}

fn nccl_failed(call: &str, e: &result::NcclError) -> TrainError {
    TrainError::Ranks { problem: format!("NCCL: {call}: {:?}; NCCL_DEBUG=WARN says more", e.0) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use freerange_train::ranks::Single;

    #[test]
    fn what_is_missing_is_named() {
        let e = Nccl::join(Rc::new(Single), &Device::flex()).unwrap_err().to_string();
        assert!(e.contains("expected a CUDA device") && e.contains("Cpu"), "{e}");
        // With the library in the loader's path an identifier can be drawn, card or not.
        match loaded() {
            Ok(()) => assert!(result::get_uniqueid().is_ok_and(|id| id.internal.iter().any(|&byte| byte != 0))),
            Err(e) => {
                assert!(e.to_string().contains("libnccl.so, ") && e.to_string().contains("LD_LIBRARY_PATH"), "{e}")
            }
        }
    }

    #[test]
    #[ignore = "wants a CUDA card and NCCL"]
    fn one_rank_gets_its_own_back() {
        let device = Device::cuda(0);
        let nccl = Nccl::join(Rc::new(Single), &device).unwrap();
        let own: Vec<f32> = (0..1000).map(|i| i as f32 - 499.5).collect();
        for dtype in [AllReduceDtype::F32, AllReduceDtype::Bf16] {
            // The first 256 whole numbers and halves are exact in bf16, too.
            let numbers = &own[372..628];
            let sum = nccl.sum(Tensor::from_floats(numbers, &device), dtype).unwrap();
            assert_eq!(sum.into_data().try_to_vec::<f32>().unwrap(), numbers);
        }
    }
}
