// As much of nanobind as cpp/bindings*.cpp use, without Python: what they define is kept under its name, and
// is called with arguments that tests/replay.py recorded. So the very bindings run where there is no Python.
#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <stdexcept>
#include <string>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

namespace nanobind {

// An argument or a result: 'i', 'f' numbers, 'a' array, 'o' object by the arguments of its constructor, 'n'
// none.
struct Value {
  char kind = 'n';
  int64_t whole = 0;
  double real = 0;
  std::string type;  // of an array, as NumPy names it: u1, i4, f4, ..
  std::vector<size_t> shape;
  std::vector<uint8_t> bytes;
  std::vector<Value> parts;
};

template <size_t N>
struct ndim {};
struct c_contig {};
namespace device {
struct cpu {};
}  // namespace device

template <class T, class... Traits>
struct ndarray;
template <class T, size_t N, class... Traits>
struct ndarray<T, ndim<N>, Traits...> {
  T* first;
  const std::vector<size_t>* sizes;

  T* data() const { return first; }
  size_t shape(size_t axis) const { return (*sizes)[axis]; }
  size_t size() const {
    size_t n = 1;
    for (size_t s : *sizes) n *= s;
    return n;
  }
};

template <class T>
std::string type_name() {
  const char* kind = std::is_floating_point_v<T> ? "f" : std::is_signed_v<T> ? "i" : "u";
  return kind + std::to_string(sizeof(T));
}

// How an argument of a type is had from a value. Objects: by their class's constructor.
template <class T>
struct From {
  static inline std::function<void(T*, std::vector<Value>&)> make;
  static constexpr bool kWritten = false;
  static bool fits(const Value& v) { return v.kind == 'o'; }
  static T get(Value& v) {
    T made;
    make(&made, v.parts);
    return made;
  }
};
template <class T>
  requires std::is_arithmetic_v<T>
struct From<T> {
  static constexpr bool kWritten = false;
  static bool fits(const Value& v) { return v.kind == 'i' || v.kind == 'f'; }
  static T get(Value& v) { return v.kind == 'i' ? static_cast<T>(v.whole) : static_cast<T>(v.real); }
};
template <class T, size_t N, class... Traits>
struct From<ndarray<T, ndim<N>, Traits...>> {
  static constexpr bool kWritten = !std::is_const_v<T>;
  static bool fits(const Value& v) {
    return v.kind == 'a' && v.shape.size() == N && v.type == type_name<std::remove_const_t<T>>();
  }
  static ndarray<T, ndim<N>, Traits...> get(Value& v) {
    return {reinterpret_cast<T*>(v.bytes.data()), &v.shape};
  }
};
template <class T>
using FromArgument = From<std::remove_cvref_t<T>>;

struct Overload {
  std::function<bool(const std::vector<Value>&)> fits;
  std::function<Value(std::vector<Value>&)> call;
  std::vector<bool> written;  // argument by argument
};

template <class... A, size_t... I>
bool all_fit(const std::vector<Value>& v, std::index_sequence<I...>) {
  return v.size() == sizeof...(A) && (FromArgument<A>::fits(v[I]) && ...);
}

template <class R, class... A, class F, size_t... I>
Value call_with(F f, std::vector<Value>& v, std::index_sequence<I...>) {
  Value result;
  if constexpr (std::is_arithmetic_v<R>)
    result.kind = 'i', result.whole = static_cast<int64_t>(f(FromArgument<A>::get(v[I])...));
  else
    f(FromArgument<A>::get(v[I])...);
  return result;
}

template <class R, class... A, class F>
Overload overload_of(F f) {
  const std::index_sequence_for<A...> all;
  return {[all](const std::vector<Value>& v) { return all_fit<A...>(v, all); },
          [f, all](std::vector<Value>& v) { return call_with<R, A...>(f, v, all); },
          {FromArgument<A>::kWritten...}};
}
template <class R, class... A>
Overload overload(R (*f)(A...)) {
  return overload_of<R, A...>(f);
}
template <class F, class R, class... A>
Overload overload_of_lambda(F f, R (F::*)(A...) const) {
  return overload_of<R, A...>(f);
}
template <class F>
Overload overload(F f) {
  return overload_of_lambda(f, &F::operator());
}

struct gil_scoped_release {};
template <class>
struct call_guard {};

struct Ignored {
  template <class T>
  void operator=(const T&) {}
};

struct module_ {
  template <class F, class... Extra>
  void def(const char* name, F f, const Extra&...) {
    functions[name].push_back(overload(f));
  }
  Ignored attr(const char*) { return {}; }

  std::map<std::string, std::vector<Overload>> functions;
};

template <class... A>
struct init {};

template <class T>
struct class_ {
  class_(module_&, const char*) {}

  template <class... A>
  void def(init<A...>) {
    From<T>::make = [](T* made, std::vector<Value>& v) {
      fill<A...>(made, v, std::index_sequence_for<A...>());
    };
  }
  template <class F>
  void def(const char*, F f) {
    set(f, &F::operator());
  }

  template <class... A, size_t... I>
  static void fill(T* made, std::vector<Value>& v, std::index_sequence<I...>) {
    *made = T{FromArgument<A>::get(v[I])...};
  }
  template <class F, class... A>
  void set(F f, void (F::*)(T*, A...) const) {
    From<T>::make = [f](T* made, std::vector<Value>& v) {
      apply<F, A...>(f, made, v, std::index_sequence_for<A...>());
    };
  }
  template <class F, class... A, size_t... I>
  static void apply(F f, T* made, std::vector<Value>& v, std::index_sequence<I...>) {
    f(made, FromArgument<A>::get(v[I])...);
  }
};

}  // namespace nanobind

#define NB_MODULE(name, m) void bind##name(nanobind::module_& m)
