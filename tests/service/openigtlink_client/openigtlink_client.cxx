// Connects to HOST PORT, sends what standard input says, writes every received message as one line
// of JSON to standard output. Words of a line on standard input:
//   hello                                     an unnamed STATUS, as Slicer sends on connecting
//   string DEVICE TEXT
//   transform DEVICE r00 r01 r02 x r10 ... z  the first three rows of the matrix
//   point DEVICE LABEL x y z [LABEL x y z ...]
// Messages go out in version 2 of the header.
#include <atomic>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <iostream>
#include <mutex>
#include <sstream>
#include <string>
#include <thread>

#include "igtlClientSocket.h"
#include "igtlImageMessage.h"
#include "igtlMessageHeader.h"
#include "igtlPointMessage.h"
#include "igtlStatusMessage.h"
#include "igtlStringMessage.h"
#include "igtlTransformMessage.h"

#if !(OpenIGTLink_HEADER_VERSION >= 2)
#error "version 3 of the library is needed: version 2 of the header, with meta-data"
#endif

namespace {

std::string quoted(const std::string& text) {
  std::ostringstream out;
  out << '"';
  for (unsigned char c : text) {
    if (c == '"' || c == '\\') out << '\\' << c;
    else if (c >= 0x20 && c < 0x7f) out << c;
  }
  out << '"';
  return out.str();
}

std::string number(double value) {
  if (!std::isfinite(value)) return "null";
  std::ostringstream out;
  out.precision(9);
  out << value;
  return out.str();
}

template <class Message> std::string metaOf(Message& message) {
  std::string out = "{";
  for (const auto& pair : message->GetMetaData()) {
    if (out.size() > 1) out += ",";
    out += quoted(pair.first) + ":" + quoted(pair.second.second);
  }
  return out + "}";
}

template <class Message> void prepare(Message& message, const std::string& device) {
  message->SetHeaderVersion(IGTL_HEADER_VERSION_2);
  message->SetDeviceName(device.c_str());
}

template <class Message> bool receiveBody(igtl::ClientSocket* socket, Message& message) {
  bool timedOut = false;
  if (!socket->Receive(message->GetPackBodyPointer(), message->GetPackBodySize(), timedOut)) return false;
  return (message->Unpack(1) & igtl::MessageHeader::UNPACK_BODY) != 0;
}

template <class Message>
typename Message::Pointer bodyOf(igtl::ClientSocket* socket, igtl::MessageHeader* header, bool& whole) {
  typename Message::Pointer message = Message::New();
  message->SetMessageHeader(header);
  message->AllocatePack();
  whole = receiveBody(socket, message);
  return message;
}

std::string matrixText(igtl::Matrix4x4& matrix) {
  std::string out = "[";
  for (int row = 0; row < 3; ++row)
    for (int col = 0; col < 4; ++col) out += (row + col ? "," : "") + number(matrix[row][col]);
  return out + "]";
}

std::string contentOf(igtl::ClientSocket* socket, igtl::MessageHeader* header, bool& whole) {
  const std::string kind = header->GetDeviceType();
  if (kind == "STATUS") {
    auto message = bodyOf<igtl::StatusMessage>(socket, header, whole);
    return "\"code\":" + std::to_string(message->GetCode()) + ",\"subcode\":" +
           std::to_string(message->GetSubCode()) + ",\"name\":" + quoted(message->GetErrorName()) +
           ",\"text\":" + quoted(message->GetStatusString()) + ",\"meta\":" + metaOf(message);
  }
  if (kind == "STRING") {
    auto message = bodyOf<igtl::StringMessage>(socket, header, whole);
    return "\"text\":" + quoted(message->GetString()) + ",\"meta\":" + metaOf(message);
  }
  if (kind == "TRANSFORM") {
    auto message = bodyOf<igtl::TransformMessage>(socket, header, whole);
    igtl::Matrix4x4 matrix;
    message->GetMatrix(matrix);
    return "\"matrix\":" + matrixText(matrix) + ",\"meta\":" + metaOf(message);
  }
  if (kind == "POINT") {
    auto message = bodyOf<igtl::PointMessage>(socket, header, whole);
    std::string out = "\"points\":[";
    for (int i = 0; whole && i < message->GetNumberOfPointElement(); ++i) {
      igtl::PointElement::Pointer point;
      message->GetPointElement(i, point);
      igtlFloat32 x, y, z;
      point->GetPosition(x, y, z);
      out += (i ? ",{" : "{") + std::string("\"name\":") + quoted(point->GetName()) + ",\"ras\":[" +
             number(x) + "," + number(y) + "," + number(z) + "],\"diameter\":" + number(point->GetRadius()) + "}";
    }
    return out + "],\"meta\":" + metaOf(message);
  }
  if (kind == "IMAGE") {
    auto message = bodyOf<igtl::ImageMessage>(socket, header, whole);
    int size[3];
    float spacing[3];
    message->GetDimensions(size);
    message->GetSpacing(spacing);
    igtl::Matrix4x4 matrix;
    message->GetMatrix(matrix);
    return "\"size\":[" + std::to_string(size[0]) + "," + std::to_string(size[1]) + "],\"spacing\":[" +
           number(spacing[0]) + "," + number(spacing[1]) + "," + number(spacing[2]) + "],\"matrix\":" +
           matrixText(matrix) + ",\"meta\":" + metaOf(message);
  }
  socket->Skip(header->GetBodySizeToRead(), 0);
  whole = true;
  return "\"skipped\":true";
}

void receive(igtl::ClientSocket* socket) {
  for (;;) {
    igtl::MessageHeader::Pointer header = igtl::MessageHeader::New();
    header->InitPack();
    bool timedOut = false;
    const auto got = socket->Receive(header->GetPackPointer(), header->GetPackSize(), timedOut);
    if (got != static_cast<decltype(got)>(header->GetPackSize())) break;
    header->Unpack();
    bool whole = false;
    const std::string kind = header->GetDeviceType(), device = header->GetDeviceName();
    const std::string content = contentOf(socket, header, whole);
    std::cout << "{\"kind\":" << quoted(kind) << ",\"device\":" << quoted(device)
              << ",\"whole\":" << (whole ? "true" : "false") << "," << content << "}" << std::endl;
  }
  std::cout << "{\"kind\":\"END\"}" << std::endl;
  std::_Exit(0);
}

template <class Message> void send(igtl::ClientSocket* socket, Message& message) {
  message->Pack();
  socket->Send(message->GetPackPointer(), message->GetPackSize());
}

void say(igtl::ClientSocket* socket, std::istringstream& words) {
  std::string what, device;
  words >> what;
  if (what == "hello") {
    igtl::StatusMessage::Pointer message = igtl::StatusMessage::New();
    prepare(message, "");
    message->SetCode(igtl::StatusMessage::STATUS_OK);
    message->SetSubCode(0);
    message->SetErrorName("");
    message->SetStatusString("");
    return send(socket, message);
  }
  words >> device;
  if (what == "string") {
    std::string text;
    std::getline(words >> std::ws, text);
    igtl::StringMessage::Pointer message = igtl::StringMessage::New();
    prepare(message, device);
    message->SetString(text);
    return send(socket, message);
  }
  if (what == "transform") {
    igtl::Matrix4x4 matrix;
    igtl::IdentityMatrix(matrix);
    std::string word;
    for (int row = 0; row < 3; ++row)
      for (int col = 0; col < 4 && words >> word; ++col) matrix[row][col] = std::strtof(word.c_str(), nullptr);
    igtl::TransformMessage::Pointer message = igtl::TransformMessage::New();
    prepare(message, device);
    message->SetMatrix(matrix);
    return send(socket, message);
  }
  if (what == "point") {
    igtl::PointMessage::Pointer message = igtl::PointMessage::New();
    prepare(message, device);
    std::string label, word[3];
    while (words >> label >> word[0] >> word[1] >> word[2]) {
      igtl::PointElement::Pointer point = igtl::PointElement::New();
      point->SetName(label.c_str());
      point->SetGroupName("Selected");
      point->SetRGBA(0xFF, 0xFF, 0x00, 0xFF);
      point->SetPosition(std::strtof(word[0].c_str(), nullptr), std::strtof(word[1].c_str(), nullptr),
                         std::strtof(word[2].c_str(), nullptr));
      point->SetRadius(1.0);
      point->SetOwner("");
      message->AddPointElement(point);
    }
    return send(socket, message);
  }
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 3) {
    std::cerr << "usage: openigtlink_client HOST PORT" << std::endl;
    return 2;
  }
  igtl::ClientSocket::Pointer socket = igtl::ClientSocket::New();
  if (socket->ConnectToServer(argv[1], std::atoi(argv[2])) != 0) {
    std::cerr << "cannot connect" << std::endl;
    return 3;
  }
  std::thread(receive, socket.GetPointer()).detach();
  std::string line;
  while (std::getline(std::cin, line)) {
    std::istringstream words(line);
    say(socket, words);
  }
  std::_Exit(0);
}
