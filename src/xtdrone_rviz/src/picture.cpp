#include "picture.h"

#include <png.h>

#include <cerrno>
#include <cstdio>
#include <cstring>
#include <stdexcept>

namespace xtdrone_rviz {

bool Picture::plain() const {
  // All pixels are equal if and only if the picture equals itself shifted by one pixel.
  return data.size() <= 3 || std::memcmp(data.data(), data.data() + 3, data.size() - 3) == 0;
}

void writePng(const Picture& picture, const std::string& path) {
  const std::string part = path + ".part";
  png_image image;
  std::memset(&image, 0, sizeof image);
  image.version = PNG_IMAGE_VERSION;
  image.width = picture.width;
  image.height = picture.height;
  image.format = PNG_FORMAT_RGB;
  image.flags = PNG_IMAGE_FLAG_FAST;
  errno = 0;
  const bool written = png_image_write_to_file(&image, part.c_str(), 0, picture.data.data(), 0, nullptr) != 0;
  if (!written || std::rename(part.c_str(), path.c_str()) != 0) {
    const std::string why = errno != 0 ? std::strerror(errno) : image.message;
    std::remove(part.c_str());
    throw std::runtime_error("picture " + path + ": cannot be written: " + why);
  }
}

}  // namespace xtdrone_rviz
