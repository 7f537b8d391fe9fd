// A client of `python -m runners.serve` that needs POSIX sockets alone: docs/serve.md.
// c++ -std=c++17 serve_client.cpp -o serve_client && CHSEL_TOKEN=... ./serve_client 8765
#include <arpa/inet.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cstdlib>
#include <iostream>
#include <stdexcept>
#include <string>
#include <vector>

struct Server {
    int port;
    std::string token;

    // The JSON that answers a JSON object.
    std::string ask(const std::string &path, const std::string &json) const {
        sockaddr_in address{};
        address.sin_family = AF_INET;
        address.sin_port = htons(port);
        address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
        const int connection = socket(AF_INET, SOCK_STREAM, 0);
        if (connect(connection, reinterpret_cast<sockaddr *>(&address), sizeof address) != 0)
            throw std::runtime_error("no server at port " + std::to_string(port));
        const std::string request = "POST " + path + " HTTP/1.1\r\nHost: 127.0.0.1\r\n"
            "Connection: close\r\nAuthorization: Bearer " + token + "\r\nContent-Length: " +
            std::to_string(json.size()) + "\r\n\r\n" + json;
        for (size_t sent = 0; sent < request.size();) {
            const ssize_t count = write(connection, &request[sent], request.size() - sent);
            if (count <= 0) throw std::runtime_error("the server hung up");
            sent += count;
        }
        std::string answer;
        char block[4096];
        for (ssize_t count; (count = read(connection, block, sizeof block)) > 0;)
            answer.append(block, count);
        close(connection);
        const std::string body = answer.substr(answer.find("\r\n\r\n") + 4);
        if (answer.compare(0, 12, "HTTP/1.1 200") != 0) throw std::runtime_error(body);
        return body;
    }
};

// What follows "name": up to the number of a text or the first number of an array.
const char *after(const std::string &json, const std::string &name) {
    const size_t place = json.find("\"" + name + "\":");
    if (place == std::string::npos) throw std::runtime_error(name + " is missing in " + json);
    return json.c_str() + json.find_first_of("-0123456789", place + name.size() + 3);
}

int main(int argc, char **argv) try {
    const char *token = std::getenv("CHSEL_TOKEN");
    if (argc != 2 || token == nullptr) throw std::runtime_error("CHSEL_TOKEN=... client PORT");
    const Server server{std::atoi(argv[1]), token};
    // A box of 0.1 x 0.06 x 0.2 m, and contacts on it at (0.4, 0, 0.1).
    const std::string box = R"({"record": "cpp.mcap", "target": {
        "vertices": [[-0.05, -0.03, -0.1], [-0.05, -0.03, 0.1], [-0.05, 0.03, -0.1],
                     [-0.05, 0.03, 0.1], [0.05, -0.03, -0.1], [0.05, -0.03, 0.1],
                     [0.05, 0.03, -0.1], [0.05, 0.03, 0.1]],
        "faces": [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                  [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]}})";
    const std::string opened = server.ask("/sessions", box);
    const std::string session = "/sessions/" + std::to_string(std::atoi(after(opened, "session")));
    server.ask(session + "/add", R"({"contacts": [
        [0.35, -0.02, 0.15], [0.35, 0.02, 0.03], [0.45, 0.01, 0.18], [0.45, -0.01, 0.05],
        [0.43, 0.02, 0.2], [0.36, -0.02, 0.2], [0.4, -0.03, 0.06], [0.38, 0.03, 0.15]]})");
    const std::string found = server.ask(session + "/register", "{}");
    const char *number = after(found, "world_from_object");  // the first of 16, row by row
    std::vector<double> pose;
    while (pose.size() < 16) {
        char *end;
        pose.push_back(std::strtod(number, &end));
        for (number = end; *number == ',' || *number == ' ' || *number == '[' || *number == ']';)
            ++number;
    }
    std::cout << "position " << pose[3] << " " << pose[7] << " " << pose[11] << "\n";
    server.ask(session + "/close", "{}");
    return 0;
} catch (const std::exception &error) {
    std::cerr << error.what() << "\n";
    return 1;
}
