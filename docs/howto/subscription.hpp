// Receive the messages of a tacpipe live session: each is young, or there is none. C++17 and POSIX, no other library.
//
//     tacpipe::Subscription session("127.0.0.1", "8765", 100);   // numeric address, port, maximum age in ms
//     while (running) {
//       auto message = session.next();                           // waits 100 ms at most
//       if (!message) hold_or_grip_harder();                     // unknown: never the last value
//       else if (message->has("alarm", "\"on\"")) grip_harder();
//     }
//
// The object belongs to one thread. It connects by itself, and again when the session ends.
#pragma once

#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cerrno>
#include <chrono>
#include <cstdint>
#include <cstdlib>
#include <optional>
#include <string>
#include <utility>

namespace tacpipe {

struct Message {
  std::string json;
  double age_ms;  // since the newest sample was measured; never too small

  // Whether the object has this field with this value, both written as in JSON. Quotes in strings are escaped in JSON.
  bool has(const std::string& name, const std::string& value) const {
    return json.find('"' + name + "\":" + value) != std::string::npos;
  }
};

class Subscription {
 public:
  Subscription(std::string host, std::string port, double max_age_ms, std::string token = "")
      : host_(std::move(host)), port_(std::move(port)), token_(std::move(token)), max_age_ms_(max_age_ms) {}
  Subscription(const Subscription&) = delete;
  Subscription& operator=(const Subscription&) = delete;
  ~Subscription() { disconnect(); }

  // Return the newest message, or none if no message of at most max_age_ms comes within that time.
  std::optional<Message> next() {
    const int64_t until_ns = now_ns() + int64_t(max_age_ms_ * 1e6);
    for (;;) {
      if (auto message = advance()) return message;
      const int64_t left_ns = until_ns - now_ns();
      if (left_ns <= 0) return std::nullopt;
      const int left_ms = int(left_ns / 1000000) + 1;
      pollfd waiting{fd_, short(is_connected_ ? POLLIN : POLLOUT), 0};
      poll(&waiting, 1, fd_ < 0 && left_ms > 50 ? 50 : left_ms);  // without a socket: wait before the next attempt
    }
  }

 private:
  static int64_t now_ns() {
    return std::chrono::nanoseconds(std::chrono::steady_clock::now().time_since_epoch()).count();
  }

  // Do what is possible without waiting: connect, ask, and read one message that is young enough.
  std::optional<Message> advance() {
    if (fd_ < 0 && !open_socket()) return std::nullopt;
    if (!is_connected_ && !send_handshake()) return std::nullopt;
    if (!receive()) return std::nullopt;
    if (!is_open_ && !read_handshake()) return std::nullopt;
    if (!is_asked_) {
      if (!send_frame(0x1, std::to_string(now_ns()))) return std::nullopt;  // text
      is_asked_ = true;
    }
    while (auto json = read_frame()) {
      const auto heard_ns = number(*json, "heard_ns"), asked_ns = number(*json, "asked_ns");
      if (!heard_ns || !asked_ns) continue;  // the description
      is_asked_ = false;
      auto measured_ns = number(*json, "sampled_ns");
      if (!measured_ns) measured_ns = number(*json, "sent_ns");
      if (!measured_ns) continue;
      const double age_ms = double(*heard_ns - *measured_ns + now_ns() - *asked_ns) / 1e6;
      if (age_ms <= max_age_ms_) return Message{std::move(*json), age_ms};
      if (!send_frame(0x1, std::to_string(now_ns()))) return std::nullopt;
      is_asked_ = true;
    }
    return std::nullopt;
  }

  bool open_socket() {
    addrinfo hints{}, *address = nullptr;
    hints.ai_socktype = SOCK_STREAM;
    hints.ai_flags = AI_NUMERICHOST | AI_NUMERICSERV;  // a name could take seconds to resolve
    if (getaddrinfo(host_.c_str(), port_.c_str(), &hints, &address) != 0) return false;
    fd_ = socket(address->ai_family, SOCK_STREAM, 0);
    if (fd_ >= 0) {
      fcntl(fd_, F_SETFL, O_NONBLOCK);
      const int on = 1, lost_ms = 3000;
      setsockopt(fd_, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
      setsockopt(fd_, SOL_SOCKET, SO_KEEPALIVE, &on, sizeof on);  // a cable that was pulled out ends the connection
#ifdef TCP_USER_TIMEOUT
      setsockopt(fd_, IPPROTO_TCP, TCP_KEEPIDLE, &on, sizeof on);
      setsockopt(fd_, IPPROTO_TCP, TCP_KEEPINTVL, &on, sizeof on);
      setsockopt(fd_, IPPROTO_TCP, TCP_USER_TIMEOUT, &lost_ms, sizeof lost_ms);
#endif
      if (connect(fd_, address->ai_addr, address->ai_addrlen) != 0 && errno != EINPROGRESS) disconnect();
    }
    freeaddrinfo(address);
    return fd_ >= 0;
  }

  bool send_handshake() {
    pollfd ready{fd_, POLLOUT, 0};
    if (poll(&ready, 1, 0) != 1) return false;
    const std::string ask = "/?pull=1&max_age_ms=" + std::to_string(max_age_ms_);
    const std::string authorization = token_.empty() ? "" : "Authorization: Bearer " + token_ + "\r\n";
    is_connected_ = send_all("GET " + ask + " HTTP/1.1\r\nHost: " + host_ + ":" + port_ + "\r\n" + authorization +
                             "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
                             "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n");
    return is_connected_;
  }

  bool read_handshake() {
    const auto end = received_.find("\r\n\r\n");
    if (end == std::string::npos) return false;
    is_open_ = received_.compare(0, 12, "HTTP/1.1 101") == 0;
    received_.erase(0, end + 4);
    if (!is_open_) disconnect();
    return is_open_;
  }

  bool receive() {
    char part[65536];
    for (;;) {
      const ssize_t count = recv(fd_, part, sizeof part, 0);
      if (count > 0) received_.append(part, size_t(count));
      else if (count < 0 && (errno == EAGAIN || errno == EWOULDBLOCK)) return true;
      else if (count < 0 && errno == EINTR) continue;
      else return disconnect();
    }
  }

  // Return the text of the next complete frame, after answering pings; none if it is not complete yet.
  std::optional<std::string> read_frame() {
    while (received_.size() >= 2) {
      const auto byte = [this](size_t place) { return uint64_t(uint8_t(received_[place])); };
      const unsigned opcode = unsigned(byte(0) & 0x0f);
      uint64_t size = byte(1) & 0x7f;
      const size_t extra = size == 126 ? 2 : size == 127 ? 8 : 0;
      if (received_.size() < 2 + extra) break;
      if (extra) size = 0;
      for (size_t place = 2; place < 2 + extra; ++place) size = size << 8 | byte(place);
      if (size > (1u << 26) || opcode == 0x8 || !(byte(0) & 0x80)) {  // too large, the end, or a fragment
        disconnect();
        break;
      }
      if (received_.size() < 2 + extra + size) break;
      std::string content = received_.substr(2 + extra, size_t(size));
      received_.erase(0, 2 + extra + size_t(size));
      if (opcode == 0x9 && !send_frame(0xa, content)) break;  // ping: pong
      if (opcode == 0x1) return content;
    }
    return std::nullopt;
  }

  // Send a short frame. Its mask of zeros leaves the content unchanged.
  bool send_frame(unsigned opcode, const std::string& content) {
    std::string frame{char(0x80 | opcode), char(0x80 | content.size())};
    return send_all(frame.append(4, '\0') + content);
  }

  bool send_all(const std::string& data) {
    return send(fd_, data.data(), data.size(), MSG_NOSIGNAL) == ssize_t(data.size()) || disconnect();
  }

  static std::optional<int64_t> number(const std::string& json, const std::string& name) {
    const auto place = json.rfind('"' + name + "\":");
    if (place == std::string::npos) return std::nullopt;
    const char* text = json.c_str() + place + name.size() + 3;
    char* end = nullptr;
    const int64_t value = std::strtoll(text, &end, 10);
    return end == text ? std::nullopt : std::optional<int64_t>(value);
  }

  bool disconnect() {
    if (fd_ >= 0) close(fd_);
    fd_ = -1;
    is_connected_ = is_open_ = is_asked_ = false;
    received_.clear();
    return false;
  }

  std::string host_, port_, token_, received_;
  double max_age_ms_;
  int fd_ = -1;
  bool is_connected_ = false, is_open_ = false, is_asked_ = false;
};

}  // namespace tacpipe
