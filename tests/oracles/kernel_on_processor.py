"""A CUDA file of PyTorch compiled for the processor: SparseOcc's renderer of voxels, `lib/dvr/dvr.cu`.

The text of the file is compiled as it is, but for its launches of kernels, which become loops over all
threads. A graphics card may fuse a product with a sum, which the processor does not.
"""

import importlib.util
import re
import subprocess
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from torch.utils.cpp_extension import include_paths, library_paths

CUDA = """
#include <torch/extension.h>
#include <cfloat>
#include <algorithm>
#include <cassert>
#define __global__
using std::max;
using std::min;
struct int3 { int x, y, z; };
inline int3 make_int3(int x, int y, int z) { return {x, y, z}; }
struct dim3 { unsigned x, y, z; dim3(long x, long y = 1, long z = 1) : x(x), y(y), z(z) {} };
static dim3 blockIdx(0), blockDim(1), threadIdx(0);
namespace at { template <typename T> struct RestrictPtrTraits { typedef T* PtrType; }; }
namespace detail {
inline at::ScalarType scalar_type(const at::DeprecatedTypeProperties& type) { return type.scalarType(); }
}
inline void cudaDeviceSynchronize() {}
template <typename A, typename B> void atomicAdd(A* sum, B value) { *sum += value; }
template <typename Kernel, typename... Args>
void run_grid(dim3 blocks, int threads, Kernel kernel, Args&&... args) {
  blockDim = dim3(threads);
  for (blockIdx.y = 0; blockIdx.y < blocks.y; blockIdx.y++)
    for (blockIdx.x = 0; blockIdx.x < blocks.x; blockIdx.x++)
      for (threadIdx.x = 0; threadIdx.x < unsigned(threads); threadIdx.x++) kernel(args...);
}
"""
MODULE = 'PYBIND11_MODULE(dvr, m) { m.def("render_forward", &render_forward_cuda); }\n'


def compiled(file: Path) -> Any:
    """The module with the file's `render_forward`, for tensors on the processor."""
    text = re.sub(r"(\w+<scalar_t>)<<<(\w+), (\w+)>>>\(", r"run_grid(\2, \3, \1, ", file.read_text())
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "dvr.cpp", Path(folder) / "dvr.so"
        source.write_text(CUDA + text + MODULE)
        for name in ("cuda.h", "cuda_runtime.h"):
            (Path(folder) / name).touch()
        folders = [folder, *include_paths(), sysconfig.get_path("include")]
        libraries = [flag for path in library_paths() for flag in (f"-L{path}", f"-Wl,-rpath,{path}")]
        command = ["g++", "-std=c++17", "-O1", "-fPIC", "-shared", "-w", str(source), "-o", str(library)]
        command += [f"-I{path}" for path in folders] + libraries
        command += ["-lc10", "-ltorch", "-ltorch_cpu", "-ltorch_python"]
        subprocess.run(command, check=True)
        spec = importlib.util.spec_from_file_location("dvr", library)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module
