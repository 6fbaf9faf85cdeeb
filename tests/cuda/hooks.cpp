// A CUDA device that is not there: what PyTorch asks of a device before it computes. All answers are constant.
#include <ATen/CPUGeneratorImpl.h>
#include <ATen/detail/CUDAHooksInterface.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>
#include <cstdlib>

namespace {
using namespace c10;

// Of processes that torchrun started, each has a card of its own
DeviceIndex number(const char* name, int without) {
  const char* given = std::getenv(name);
  return static_cast<DeviceIndex>(given ? std::atoi(given) : without);
}
const DeviceIndex own = number("LOCAL_RANK", 0), cards = number("LOCAL_WORLD_SIZE", 1);

struct EmulatedGuard final : impl::DeviceGuardImplInterface {
  static constexpr DeviceType static_type = DeviceType::CUDA;
  DeviceType type() const override { return static_type; }
  Device exchangeDevice(Device device) const override { return device; }
  Device getDevice() const override { return Device(static_type, own); }
  void setDevice(Device) const override {}
  void uncheckedSetDevice(Device) const noexcept override {}
  Stream getStream(Device device) const override { return Stream(Stream::DEFAULT, device); }
  Stream getDefaultStream(Device device) const override { return Stream(Stream::DEFAULT, device); }
  Stream getStreamFromGlobalPool(Device device, bool) const override { return Stream(Stream::DEFAULT, device); }
  Stream getNewStream(Device device, int) const override { return Stream(Stream::DEFAULT, device); }
  Stream exchangeStream(Stream stream) const override { return stream; }
  DeviceIndex deviceCount() const noexcept override { return cards; }
  void record(void**, const Stream&, const DeviceIndex, const EventFlag) const override {}
  void block(void*, const Stream&) const override {}
  bool queryEvent(void*) const override { return true; }
  void destroyEvent(void*, const DeviceIndex) const noexcept override {}
  bool queryStream(const Stream&) const override { return true; }
  void synchronizeStream(const Stream&) const override {}
};

struct CUDAHooks final : at::CUDAHooksInterface {
  explicit CUDAHooks(at::CUDAHooksArgs) {}
  void init() const override {}
  bool isBuilt() const override { return true; }
  bool isAvailable() const override { return true; }
  bool hasCUDA() const override { return true; }
  bool hasPrimaryContext(DeviceIndex) const override { return true; }
  DeviceIndex deviceCount() const override { return cards; }
  DeviceIndex current_device() const override { return own; }
  DeviceIndex getCurrentDevice() const override { return own; }
  int getNumGPUs() const override { return cards; }
  void deviceSynchronize(DeviceIndex) const override {}
  bool isPinnedPtr(const void*) const override { return false; }
  const at::Generator& getDefaultGenerator(DeviceIndex) const override {
    return at::detail::getDefaultCPUGenerator();
  }
  at::Generator getNewGenerator(DeviceIndex) const override { return at::detail::createCPUGenerator(); }
};
}  // namespace

namespace at {
using c10::DeviceType;
REGISTER_CUDA_HOOKS(CUDAHooks)  // PyTorch looks for this name
}
C10_REGISTER_GUARD_IMPL(CUDA, EmulatedGuard);
