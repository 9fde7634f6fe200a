# freerange in a container: `docker build -t freerange .`, for NVIDIA cards `docker build -t freerange:cuda --build-arg VARIANT=cuda .`
#
#     docker run --rm -v "$PWD:/work" -u "$(id -u)" freerange reconstruct SCENE -o out
#     docker run --rm -p 127.0.0.1:7878:7878 freerange serve --host 0.0.0.0      # prints a link with a token; open it at 127.0.0.1
#     docker run --rm --gpus all freerange:cuda devices
#
# Arguments: VARIANT, cpu or cuda; FEATURES, further Cargo features, as in FEATURES=fetch,cloud.
ARG VARIANT=cpu
ARG CUDA=12.9.1

FROM rust:1.95-bookworm AS build-cpu
ENV DEVICE=

# With NVIDIA's compiler beside it the build takes the functions of this CUDA, not of the latest.
FROM nvidia/cuda:${CUDA}-devel-ubuntu24.04 AS build-cuda
ENV DEVICE=freerange-cli/cuda RUSTUP_HOME=/usr/local/rustup CARGO_HOME=/usr/local/cargo PATH=/usr/local/cargo/bin:$PATH
# Security fixes of the distribution are wanted: nothing is pinned.
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install -y --no-install-recommends ca-certificates gcc g++ libc6-dev rustup \
 && rm -rf /var/lib/apt/lists/* \
 && rustup toolchain install 1.95 --profile minimal \
 && rustup default 1.95

# hadolint ignore=DL3006
FROM build-${VARIANT} AS build
ARG FEATURES=
WORKDIR /src
COPY . .
# One layer for the program alone; what is built stays in a cache.
RUN --mount=type=cache,target=/usr/local/cargo/registry --mount=type=cache,target=/src/target,id=target-${DEVICE} \
    cargo build --release --locked --features "${DEVICE},${FEATURES}" \
 && install -D target/release/freerange /out/freerange

FROM debian:bookworm-slim AS run-cpu

# Kernels are compiled when they are first needed: that takes NVRTC and CUDA's headers; the driver is the host's.
FROM nvidia/cuda:${CUDA}-base-ubuntu24.04 AS run-cuda
ARG CUDA
ENV CUDA_PATH=/usr/local/cuda
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
# hadolint ignore=DL3008
RUN version=$(echo "${CUDA}" | cut -d. -f1,2 | tr . -) \
 && apt-get update \
 && apt-get install -y --no-install-recommends \
      "cuda-nvrtc-${version}" "cuda-cudart-dev-${version}" "cuda-cccl-${version}" "cuda-crt-${version}" \
 && rm -rf /var/lib/apt/lists/*

# hadolint ignore=DL3006
FROM run-${VARIANT}
RUN useradd --uid 10001 --create-home freerange && mkdir /work && chown freerange /work
COPY --from=build /out/freerange /usr/local/bin/freerange
COPY LICENSE-APACHE LICENSE-MIT /usr/share/doc/freerange/
USER 10001
WORKDIR /work
ENTRYPOINT ["freerange"]
CMD ["--help"]
