// replay RECORDING: repeats every call of the core that tests/replay.py recorded, and compares what it writes
// and returns, bit for bit. Prints the functions with their calls and how many differ; exits with 1 if any
// does.
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>

#include "nanobind/nanobind.h"
#include "simd.h"

namespace nb = nanobind;

void bind_core(nb::module_& m);  // bindings.cpp

namespace {

struct Reader {
  explicit Reader(const char* path) : in(path, std::ios::binary) {
    if (!in) throw std::runtime_error(std::string("cannot read ") + path);
  }

  bool more() { return in.peek() != std::ifstream::traits_type::eof(); }
  void bytes(void* to, size_t n) {
    if (n && !in.read(static_cast<char*>(to), static_cast<std::streamsize>(n)))
      throw std::runtime_error("the recording ends too early");
  }
  template <class T>
  T number() {
    T v;
    bytes(&v, sizeof v);
    return v;
  }
  std::string word() {
    std::string s(number<uint8_t>(), ' ');
    bytes(s.data(), s.size());
    return s;
  }
  nb::Value value() {
    nb::Value v;
    v.kind = number<char>();
    if (v.kind == 'i') v.whole = number<int64_t>();
    if (v.kind == 'f') v.real = number<double>();
    if (v.kind == 'o') v.parts = values();
    if (v.kind == 'a') {
      v.type = word();
      v.shape.resize(number<uint8_t>());
      for (size_t& s : v.shape) s = static_cast<size_t>(number<int64_t>());
      v.bytes = array();
    }
    return v;
  }
  std::vector<uint8_t> array() {
    std::vector<uint8_t> a(static_cast<size_t>(number<int64_t>()));
    bytes(a.data(), a.size());
    return a;
  }
  std::vector<nb::Value> values() {
    std::vector<nb::Value> v(number<uint8_t>());
    for (nb::Value& each : v) each = value();
    return v;
  }

  std::ifstream in;
};

struct Call {
  explicit Call(Reader& from) : name(from.word()), arguments(from.values()), result(from.value()) {
    for (const nb::Value& v : arguments) after.push_back(v.bytes);
    for (int n = from.number<uint8_t>(); n > 0; --n) {
      const size_t which = from.number<uint8_t>();
      after.at(which) = from.array();
    }
  }

  std::string name;
  std::vector<nb::Value> arguments;
  nb::Value result;
  std::vector<std::vector<uint8_t>> after;  // the arguments' bytes
};

// What is in memory that a function only borrows means nothing.
bool is_scratch(const Call& call, size_t argument) { return call.name == "aggregates" && argument == 11; }

const nb::Overload& overload_of(const nb::module_& core, const Call& call) {
  const auto found = core.functions.find(call.name);
  if (found != core.functions.end())
    for (const nb::Overload& each : found->second)
      if (each.fits(call.arguments)) return each;
  throw std::runtime_error("no function takes the arguments of " + call.name);
}

bool alike(const nb::module_& core, Call& call) {
  const nb::Overload& function = overload_of(core, call);
  const nb::Value result = function.call(call.arguments);
  bool same = result.whole == call.result.whole;
  for (size_t i = 0; i < call.arguments.size(); ++i)
    if (function.written[i] && !is_scratch(call, i)) same = same && call.arguments[i].bytes == call.after[i];
  return same;
}

int replay(const char* path) {
  nb::module_ core;
  bind_core(core);
  std::map<std::string, std::pair<int, int>> counts;  // calls, and those that differ
  for (Reader reader(path); reader.more();) {
    Call call(reader);
    auto& [calls, differ] = counts[call.name];
    ++calls;
    differ += !alike(core, call);
  }
  bool all = !counts.empty();
  for (const auto& [name, count] : counts) {
    std::printf("%s %d %d\n", name.c_str(), count.first, count.second);
    all = all && count.second == 0;
  }
  std::printf("simd %s\n", seepast::simd_name());
  return all ? 0 : 1;
}

}  // namespace

int main(int count, char** arguments) {
  try {
    if (count != 2) throw std::runtime_error("usage: replay RECORDING");
    return replay(arguments[1]);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "replay: %s\n", error.what());
    return 2;
  }
}
